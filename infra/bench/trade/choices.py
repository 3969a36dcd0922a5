"""If you need this, choose that: needs and settings as data; every figure comes from results."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Choice:
    """One row of the table."""

    need: str
    """In a user's words."""
    how: str
    """What to type, or where it is said."""
    knob: str
    """Whose curve tells what it costs."""
    setting: str
    """Its point."""
    despite: str = ""
    """Why it is advised where its point is not on the front; a test asks for it then."""


CHOICES: tuple[Choice, ...] = (
    Choice(
        need="a first look at a training, in minutes",
        how="`--noise-floor 34`",
        knob="noise-floor",
        setting="34 dB",
    ),
    Choice(
        need="targets to train on for weeks",
        how="`pretrain-256` as it is",
        knob="noise-floor",
        setting="46 dB",
    ),
    Choice(
        need="pictures to judge networks by",
        how="`--noise-floor 50` with a high cap",
        knob="noise-floor",
        setting="50 dB",
    ),
    Choice(
        need="direct light and one bounce only",
        how="`--set renders.max_depth=3`",
        knob="depth",
        setting="3",
    ),
    Choice(
        need="the fewest triangles for a network",
        how="`--set scenes.max_triangles=768`",
        knob="scene-budget",
        setting="768 triangles",
    ),
    Choice(
        need="scenes whose worst objects lose less of their shape",
        how="`--set scenes.max_triangles=4096`",
        knob="scene-budget",
        setting="4096 triangles",
    ),
    Choice(
        need="meshes for somewhere else, within a known distance",
        how="`trilight assets --epsilon 0.5%`",
        knob="epsilon",
        setting="0.5 %",
    ),
    Choice(
        need="triangles of even size",
        how="`--set assets.profile=uniform`",
        knob="profile",
        setting="uniform",
        despite="`faithful` is nearer and cheaper, and uneven, which this error does not see",
    ),
    Choice(
        need="pictures without any loss from packing",
        how="`--set storage.profile=lossless`",
        knob="codec",
        setting="profile lossless",
        despite="HTJ2K is smaller and as exact, but few programs read it yet",
    ),
    Choice(
        need="lights to be mixed anew while training",
        how="`--set renders.per_light=true`",
        knob="lights",
        setting="one picture of each light",
    ),
    Choice(
        need="as many different scenes as possible",
        how="`--set scenes.num_views=1`",
        knob="views",
        setting="1",
    ),
    Choice(
        need="a large network's picture soon",
        how="`trilight render --engine neural --precision bfloat16`",
        knob="precision",
        setting="bfloat16",
    ),
    Choice(
        need="a picture whose error is known",
        how="`trilight render` as it is: path traced to 40 dB, or to what the outcome says",
        knob="noise-floor",
        setting="40 dB",
    ),
    Choice(
        need="to see what a network has learnt",
        how="`trilight render --engine neural`",
        knob="engines",
        setting="network",
        despite="one denoised sample of the path tracer is nearer; a film of one scene costs less",
    ),
)
