"""Assigns files of a folder to textures and their components, by the words of their names.

The words are those of the large collections (ambientCG, Poly Haven, FreePBR, Poliigon, cgbookcase,
ShareTextures, 3DTextures, TextureCan, Quixel, MatSynth) and of exports (Substance, Sketchfab, glTF,
Unreal). A name without such a word is a color in a folder of such names alone; next to files whose
names have one, it is a color only where they belong to it, and otherwise it is unknown.
"""

import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

_WORDS: Mapping[str, str] = {
    "base": r"base(?:[-_ ]?(?:colou?r|map))?|albedo(?:[-_ ]?transparency)?|alb|diff|dif|"
    r"diffuse(?:[-_ ]?colou?r)?|colou?r|col|bc|basecolou?r[-_ ]opacity|b-o",
    "specular": r"specular(?:[-_ ]?colou?r)?|spec|refl|reflection",
    "roughness": r"roughness|rough|rgh",
    "metallic": r"metallic|metalness|metal",
    "gloss": r"gloss|glossiness|smoothness",
    "orm": r"orm|arm|ao[-_ ]?r[-_ ]?m|occlusion[-_ ]?roughness[-_ ]?metal(?:lic|ness)|"
    r"metal(?:lic|ness)?[-_ ]?rough(?:ness)?",
    "rma": r"rma|rmo|rmao",
    "mra": r"mra|mro|mrao",
    "ord": r"ord|ordp",
    "normal": r"(?:(?:world|ws|bent|detail)[-_ ]?)?(?:normals?|norm|nor|nrm|nmap|nrml)"
    r"(?:[-_ ]?map)?(?:[-_ ]?(?:gl|dx|ogl|opengl|directx|directx[-_ ]?9|d3d|ue|unity|16|8|[+-]?y))*"
    r"|bump(?:[-_ ]?map)?(?:16)?",
    "height": r"(?:height|displacement|displace|displ|disp|parallax|depth)(?:[-_ ]?map)?(?:16)?",
    "occlusion": r"(?:mixed[-_ ]?)?(?:ambient[-_ ]?occ(?:lusion)?|occlusion|occ|ao)(?:[-_ ]?map)?",
    "opacity": r"opacity|alpha|alpha[-_ ]?mask(?:ed)?|mask|transparency|cutout",
    "emission": r"emission|emissive|emit|emissi(?:on|ve)[-_ ]?colou?r|glow",
    "other": r"(?:ca|conca|conve)vity|curvature|curv|thickness|translucen(?:cy|t)|transmission|"
    r"subsurface|sss|scatter(?:ing)?|fuzz|sheen(?:[-_ ]?colou?r)?|anisotrop\w*|clear[-_ ]?coat\w*|"
    r"ior|id|id[-_ ]?map|mask[-_ ]?map|detail(?:[-_ ]?map)?|spec(?:ular)?[-_ ]?"
    r"(?:level|f0|ior|gloss\w*|smoothness)|metal(?:lic|ness)[-_ ]?smoothness|diffuse[-_ ]?"
    r"roughness|rough[-_ ]?ao",
    "preview": r"preview|thumb|thumbnail|thumbs|render|rendering",
}
"""Words in file names, by the component that they stand for."""

_OTHER_LANGUAGES: Mapping[str, str] = {
    "base": "(?:grund)?farbe|diffus|couleur(?:[-_ ]?de[-_ ]?base)?|difuso|color[-_ ]?base|diffuso|"
    "colore(?:[-_ ]?base)?|kolor|kleur|цвет|颜色|基础色|漫反射|ベースカラー|カラー",
    "specular": "spekular|speculaire|especular|speculare",
    "roughness": "rau(?:h?igk|h?h?)eit|rugosite|rugosidade?|rugosita|ruvid(?:ezza|ita)|"
    "chropowatosc|ruwheid|шероховатость|粗糙度?|ラフネス|粗さ",
    "metallic": "metall(?:isch|izitat)?|metalli(?:que|cite)|metalic(?:o|idade?)|metallico|"
    "металличность|金属度?|メタリック",
    "gloss": "glanz(?:grad)?|brillance|brillo|brilho|lucentezza|po[lł]ysk|glans|光泽度?|光沢",
    "normal": "normale[nrs]?(?:map|karte|textur)?|normalna|нормал[иь]|法[线線](?:贴图)?|ノーマル",
    "height": "hohe(?:n(?:map|karte))?|hoehe(?:n(?:map|karte))?|verschiebung|hauteur|"
    "deplacement|altura|desplazamiento|altezza|wysokosc|hoogte|spostamento|deslocamento|высота|高度|置换|ハイト",
    "occlusion": "(?:umgebungs)?(?:verdeckung|okklusion)|occlusion[-_ ]?ambiante|"
    "oclusion(?:[-_ ]?ambiental)?|occlusione(?:[-_ ]?ambientale)?|oclusao|环境光遮蔽|遮蔽",
    "opacity": "deckkraft|transparen(?:z|ce|cia)|opaci(?:te|dade?|ta)|trasparenza|不透明度?",
    "emission": "leuchten|leuchtkraft|emissiv|emision|emissione|emissao|自发光|発光",
    "other": "glanzlicht|reflexion|reflexao|riflessione|高光",
    "preview": "vorschau|apercu|vista[-_ ]?previa|anteprima|预览",
}
"""The same in German, French, Spanish, Italian, Portuguese, Polish, Dutch, Russian, Chinese and
Japanese, without accents."""

PACKED: Mapping[str, Mapping[str, int]] = {
    "orm": {"roughness": 1, "metallic": 2},
    "rma": {"roughness": 0, "metallic": 1},
    "mra": {"metallic": 0, "roughness": 1},
    "ord": {"roughness": 1},
}
"""Channels of pictures that hold several components, by the letters that name them."""

TEXTURE_PARTS = ("base", "specular", "roughness", "metallic")
"""Components of a texture that are read."""

_READ = (*TEXTURE_PARTS, "gloss", *PACKED)

_LETTERS = {"b": "base", "c": "base", "d": "base", "n": "normal", "r": "roughness", "h": "height"}
_UNCLEAR = ("a", "e", "g", "m", "o", "s")
"""Last letters of names whose meaning differs between collections."""

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".tga", ".webp", ".exr")
"""Suffixes of pictures, in lower case; of two pictures of one component, the earlier suffix wins.
"""

_PLAIN = re.compile("(?i)metall?|mask|alpha|depth|glow|emit|thickness|id")
"""Words that may also be the whole name of a color picture."""

_LATER = (".webp", ".exr")

_BETWEEN = "[-_. ]+"
_SIZE = r"\d{1,2}k(?:[-_](?:jpe?g|png|tiff?|exr))?|\d{3,5}(?:x\d{3,5})?(?:px)?|(?:hi|low)[-_]?res"
_NOTHING = r"tex(?:ture)?|map|v\d{1,3}|\(\d{1,3}\)|copy|final"
"""Words after that of a component which carry no meaning."""
_TAIL = (
    rf"(?:{_BETWEEN}(?:srgb|raw|linear|acescg))?"
    rf"(?P<kind>(?:{_BETWEEN}(?:var)?\d{{1,2}})?)"
    rf"(?P<tail>(?:{_BETWEEN}(?:{_SIZE}|{_NOTHING}))*(?:{_BETWEEN}(?:metalness|specular|lod\d))?)"
)
_PARTS = "|".join(
    f"(?P<{part}>{words}|{_OTHER_LANGUAGES.get(part, words)})" for part, words in _WORDS.items()
)
_NAME = re.compile(rf"(?i)(?:(?P<set>.+?){_BETWEEN})?(?:{_PARTS}){_TAIL}")
_LETTER = re.compile(rf"(?i)(?P<set>.+?){_BETWEEN}(?P<letter>[a-z]){_TAIL}")
_LAST_WORD = re.compile(r"(?P<set>.+)[-_. /]+(?P<word>[^\W\d_]{3,})")
_FOLDERS = re.compile(
    r"(?i)(?:(?P<base>base[-_ ]?colou?rs?|albedos?|diffuse)|(?P<roughness>roughness)|(?P<metallic>"
    r"metallic|metalness)|(?P<gloss>gloss|glossiness)|(?P<normal>normals?)|(?P<height>heights?|"
    r"displacement)|(?P<occlusion>ao|ambient[-_ ]?occlusion)|(?P<opacity>opacity))"
)
"""Names of folders with one component each, whose files have the names of textures."""
_CAMEL = re.compile(
    "(?<=[a-z0-9])(?=(?:Roughness|Normal|Albedo|BaseColou?r|Metallic|Metalness|Specular|Diffuse|"
    "Displacement|Height|AmbientOcclusion|Glossiness|Opacity|Emissive|Colou?r|Rough|"
    "Farbe|Rauheit|Rauigkeit|Normale|Couleur|Rugosite|Rugosidad|Ruvidezza)(?![a-z]))"
)
_NO_COLOR = re.compile(
    r"(?i)(?:.*[-_. (])?(?:normals?(?:map)?|nrm|nmap|roughness|metallic|metalness|displacement|"
    r"ao|height(?:map)?|specular|glossiness|opacity|emissive|d3d|dx(?:9|11)?|directx|opengl|"
    r"rauheit|rauigkeit|normale|rugosi\w+|hauteur|metalli(?:que|sch)|deckkraft|法[线線]|粗糙度?|金属度)"
    r"(?:[-_. )].*)?"
)
"""Names with a word that rules out a color picture."""


@dataclass(frozen=True)
class _ParsedName:
    """The parsed name of a file."""

    key: str
    """Folder and name of the set: equal for all files of one texture set."""
    stem: str
    """Name of the texture where the file is its color: the set and the color variant."""
    part: str
    kind: str = ""
    """Color variant of the set that the file is, or belongs to."""


def group_textures(
    names: Sequence[str],
) -> tuple[dict[str, dict[str, str]], dict[str, tuple[str, str]]]:
    """Group picture files by texture and component; return reasons for the unused files too.

    Args:
        names: paths of pictures, with / between their parts.

    Returns:
        File names by component of each texture, each with a component "base", in order of the
        textures' names; reason and message by name of each unused file.
    """
    names = sorted(names, key=lambda name: (name.lower().endswith(_LATER), name))
    stems = {name: name.rpartition(".")[0] for name in names}
    named = {name: entry for name in names if (entry := _parse_name(stems[name])) is not None}
    _add_letters(stems, named)
    _add_colors(stems, named)
    message = "its name says no part that is known; end it in _color, or move it away"
    unknown = [name for name in names if name not in named]
    unused = dict.fromkeys(unknown, ("unknown_map", message))
    parts: dict[tuple[str, str], dict[str, str]] = defaultdict(dict)
    for name, entry in named.items():
        if entry.part not in _READ:
            message = f"it is a map of {entry.part}; expected colors, metallic and roughness"
            unused[name] = ("map_not_used", message)
        elif parts[entry.key, entry.kind].setdefault(entry.part, name) != name:
            unused[name] = ("name_clash", "another file of the same name is taken; rename one")
    _drop_packed(parts.values(), unused)
    textures = {}
    used = set()
    bases = [(files["base"], at) for at, files in parts.items() if "base" in files]
    for name, at in sorted(bases, key=lambda base: (named[base[0]].stem, base[0])):
        shared = (at[0], "")
        textures[named[name].stem] = {**parts.get(shared, {}), **parts[at]}
        used |= {shared, at}
    for at, rest in parts.items():
        for part, name in rest.items() if at not in used else ():
            message = (
                f"it is the {part} of {''.join(at)}, which has no base color; add or rename it"
            )
            unused[name] = ("no_base_colour", message)
    return textures, unused


def is_part_folder(name: str) -> bool:
    """Return whether a folder of this name holds one component of many textures."""
    return _FOLDERS.fullmatch(name) is not None


def _add_colors(stems: Mapping[str, str], named: dict[str, _ParsedName]) -> None:
    """Add files whose names state no component, where the files next to them make them colors."""
    with_color = {entry.key for entry in named.values() if entry.part == "base"}
    keys = {entry.key for entry in named.values()}
    folders = {stems[name].rpartition("/")[0] for name in named}
    unnamed = {name: stem for name, stem in stems.items() if name not in named}
    repeated = _find_repeated(unnamed.values())
    for name, stem in unnamed.items():
        is_alone = stem.rpartition("/")[0] not in folders and not name.lower().endswith(".exr")
        is_alone &= stem not in repeated
        is_alone &= not _NO_COLOR.fullmatch(_without_accents(stem.rpartition("/")[2]))
        if is_alone or (stem in keys and stem not in with_color):
            named[name] = _ParsedName(stem, stem, "base")


def _find_repeated(stems: Iterable[str]) -> set[str]:
    """Return the names of which several sets end in the same three words or more: parts, no colors.

    The words may be of any language.
    """
    sets: dict[str, dict[str, str]] = defaultdict(dict)
    for stem in stems:
        if match := _LAST_WORD.fullmatch(stem):
            sets[match["set"]][match["word"].lower()] = stem
    counts = Counter(frozenset(words) for words in sets.values())
    return {
        stem
        for words in sets.values()
        for stem in words.values()
        if len(words) > 2 and counts[frozenset(words)] > 1
    }


def _parse_name(path: str) -> _ParsedName | None:
    folder, slash, name = path.rpartition("/")
    inner = f"{folder}{slash}"
    match = _match_name(name) or _match_name(_without_accents(name))
    if match is not None:
        part = next(part for part in _WORDS if match[part])
        if match["set"] is not None:
            key = f"{inner}{match['set']}{match['tail']}"
            stem = f"{inner}{match['set']}{match['kind']}{match['tail']}"
            return _ParsedName(key, stem, part, match["kind"])
        if part not in ("other", "preview") and not _PLAIN.fullmatch(match[part]):
            # `oak/color.png`: the folder is the set
            return _ParsedName(f"{inner}{match['tail']}", path, part, match["kind"])
    above, slash, last = folder.rpartition("/")
    within = _FOLDERS.fullmatch(last)
    if within is not None:
        part = next(part for part, word in within.groupdict().items() if word)
        return _ParsedName(f"{above}{slash}{name}", path, part)
    return None


def _match_name(name: str) -> re.Match[str] | None:
    return _NAME.fullmatch(_CAMEL.sub("_", name))


def _without_accents(name: str) -> str:
    return "".join(c for c in unicodedata.normalize("NFD", name) if not unicodedata.combining(c))


def _add_letters(stems: Mapping[str, str], named: dict[str, _ParsedName]) -> None:
    """Add files whose names end in a letter, where their set or a color explains it."""
    letters: dict[str, dict[str, str]] = defaultdict(dict)
    for name, stem in stems.items():
        match = _LETTER.fullmatch(stem) if name not in named else None
        if match is not None:
            letters[f"{match['set']}{match['tail']}"][name] = match["letter"].lower()
    parsed_keys = {entry.key for entry in named.values()}
    bare = {stem for name, stem in stems.items() if name not in named}
    for key, files in letters.items():
        said = {*files.values()}
        is_set = said <= {*_LETTERS, *_UNCLEAR} and len(said & {"b", "c", "d"}) == 1
        beside_color = key in bare and said <= {"n", "s", "r", "h", "e"}
        if beside_color or (is_set and ("n" in said or key in parsed_keys)):
            for name, letter in files.items():
                named[name] = _ParsedName(key, key, _LETTERS.get(letter, "other"))


def _drop_packed(parts: Iterable[dict[str, str]], unused: dict[str, tuple[str, str]]) -> None:
    """Leave out packed pictures whose components exist as separate pictures."""
    for files in parts:
        for part in [part for part in files if part in PACKED]:
            if all(other in files for other in PACKED[part]):
                message = "its channels are here as pictures of their own"
                unused[files.pop(part)] = ("map_not_used", message)
        if "roughness" in files and "gloss" in files:
            unused[files.pop("gloss")] = ("map_not_used", "there is a map of roughness")
