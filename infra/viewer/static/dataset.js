// The page of a dataset: any number of scenes, of which only those in sight are fetched.

import { askJson, byId, copy, element, KeptForm, onChange, page, say, sleep, some } from "./ask.js";

const form = byId("filters");
const LOOK_AGAIN_MS = 700;
const kept = new KeptForm(form);
let rows = [];
let generation = 0;

function query(first) {
  const asked = new URLSearchParams({ from: first });
  const limits = [];
  for (const { name, value, dataset } of form.elements) {
    if (!name || value === "") continue;
    if (dataset.limit) limits.push(`${dataset.limit} ${Number(value)}`);
    else asked.set(name, value);
  }
  if (limits.length) asked.set("where", limits.join(" and "));
  return asked.toString();
}

async function show(first) {
  const mine = first ? generation : ++generation;
  kept.keep();
  try {
    const found = await askJson(`api/rows?${query(first)}`);
    if (mine !== generation) return;
    if (!first) {
      rows = [];
      byId("scenes").replaceChildren();
    }
    rows.push(...found.rows);
    byId("scenes").append(...found.rows.map(card));
    page(rows.length, found.total, `${found.of.toLocaleString("en")} scenes`);
    byId("command-part").hidden = !found.command;
    byId("command").textContent = found.command;
    say("");
  } catch (error) {
    if (mine === generation) say(error);
  }
}

function thumbnail(row, view, px) {
  return element("img", {
    src: `api/thumbnail/${row.key}/${view}?px=${px}`, loading: "lazy", decoding: "async",
    alt: `scene ${row.key}, view ${view}`,
  });
}

function card(row) {
  const made = element("button", { type: "button", className: "card" },
    element("span", { className: "thumb" }, thumbnail(row, 0, 160)),
    element("b", {}, row.key), element("small", {}, short(row)));
  made.addEventListener("click", () => enlarge(rows.indexOf(row)));
  return made;
}

const short = (row) => `${row.template}, ${row.split}; ${row.triangles.toLocaleString("en")} tri, ${
  some(row.lights, "light")}; ${row.floor.toFixed(1)} dB`;

function enlarge(at) {
  const row = rows[at];
  if (!row) return;
  byId("large").dataset.at = at;
  byId("large-name").textContent = `Scene ${row.key}`;
  byId("large-open").href = `scene/${row.key}/`;
  byId("large-facts").textContent = `${short(row)} in its worst view; objects cover at least ${
    (100 * row.coverage).toFixed(0)} % of a view; at most ${row.spp} samples a pixel.`;
  byId("large-views").replaceChildren(
    ...Array.from({ length: row.views }, (_, view) => thumbnail(row, view, 512)));
  byId("before").disabled = at === 0;
  byId("after").disabled = at === rows.length - 1;
  if (!byId("large").open) byId("large").showModal();
}

const move = (step) => enlarge(Number(byId("large").dataset.at) + step);

function fill(name, values) {
  const select = form.elements[name];
  const known = new Set([...select.options].map((option) => option.value));
  for (const value of values) if (!known.has(value)) select.append(new Option(value, value));
  kept.restore();
}

// While the index is read, the page grows with it.
async function watch() {
  for (let before = -1; ;) {
    const facts = await askJson("api/dataset");
    document.title = `${facts.name} – Trilight`;
    byId("name").textContent = facts.name;
    fill("split", facts.splits);
    fill("template", facts.templates);
    const going = facts.shards_read < facts.shards;
    const reading = going ? `; reading the index: ${facts.indexed.toLocaleString("en")}` : "";
    byId("facts").textContent =
      `${facts.build}; ${some(facts.scenes, "scene")} in ${some(facts.shards, "shard")}${reading}`;
    if (facts.problems.length) say(facts.problems.join(" "));
    if (facts.indexed !== before && (before <= 0 || !going)) await show(0);
    before = facts.indexed;
    if (!going) return;
    await sleep(LOOK_AGAIN_MS);
  }
}

onChange(form, () => show(0), 200);
byId("more").addEventListener("click", () => show(rows.length));
byId("copy").addEventListener("click", () => copy(byId("command"), byId("copy")));
byId("close").addEventListener("click", () => byId("large").close());
byId("before").addEventListener("click", () => move(-1));
byId("after").addEventListener("click", () => move(1));
byId("large").addEventListener("keydown", (event) => {
  if (event.key === "ArrowLeft") move(-1);
  if (event.key === "ArrowRight") move(1);
});
watch().then(() => document.body.classList.add("ready")).catch(say);
