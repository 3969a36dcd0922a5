// The page of a folder of scene files: names at once, and of those in sight what they hold.

import { askJson, byId, element, KeptForm, onChange, page, say, some } from "./ask.js";

const form = byId("filters");
const kept = new KeptForm(form);
const PAGE = 100;
let files = [];
let shown = [];
let cards = 0;
const queue = [];
let busy = false;

const sight = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries) {
    const at = queue.indexOf(target);
    if (isIntersecting && at < 0 && !target.dataset.told) queue.push(target);
    if (!isIntersecting && at >= 0) queue.splice(at, 1);
  }
  fetchAll();
});

// One file after another: who reads and traces does one thing at a time.
async function fetchAll() {
  if (busy) return;
  busy = true;
  while (queue.length) {
    const card = queue.shift();
    if (card.isConnected) await tell(card);
  }
  busy = false;
}

async function tell(card) {
  const small = card.querySelector("small");
  card.classList.add("busy");
  try {
    const found = await askJson(`api/about/${card.dataset.number}`);
    small.textContent = about(found);
    const image = card.querySelector("img");
    image.src = `api/thumbnail/${card.dataset.number}`;
    await image.decode().catch(() => { small.textContent += "; it cannot be traced"; });
  } catch (error) {
    small.textContent = error.message;
  }
  card.dataset.told = "1";
  card.classList.remove("busy");
}

const about = (found) => [some(found.triangles, "triangle"), some(found.lights, "light"),
  found.textures ? some(found.textures, "texture") : "", some(found.views, "camera"),
  found.notes ? some(found.notes, "note") : ""].filter(Boolean).join(", ");

// A long name may go on in the next line after a slash.
const breakable = (name) => name.split("/")
  .flatMap((part, at) => (at ? ["/", element("wbr"), part] : [part]));

function card(number) {
  const made = element("a", { href: `scene/${number}/`, className: "card" },
    element("span", { className: "thumb" }, element("img", { alt: "" })),
    element("b", {}, ...breakable(files[number])), element("small", {}, ""));
  made.dataset.number = number;
  sight.observe(made);
  return made;
}

function more() {
  byId("scenes").append(...shown.slice(cards, cards + PAGE).map(card));
  cards = Math.min(shown.length, cards + PAGE);
  page(cards, shown.length, some(files.length, "file"));
}

function filter() {
  const text = form.elements.text.value.toLowerCase();
  const suffix = form.elements.form.value;
  shown = Array.from(files.keys()).filter((number) => {
    const name = files[number].toLowerCase();
    return name.includes(text) && name.endsWith(suffix);
  });
  kept.keep();
  cards = queue.length = 0;
  byId("scenes").replaceChildren();
  more();
}

async function begin() {
  const facts = await askJson("api/folder");
  ({ files } = facts);
  document.title = `${facts.name} – Trilight`;
  byId("name").textContent = facts.name;
  byId("facts").textContent = `A folder of scene files${
    facts.is_cut ? `, of which the first ${files.length.toLocaleString("en")} are listed` : ""}`;
  form.elements.form.append(...facts.forms.map((suffix) => new Option(suffix, suffix)));
  kept.restore();
  filter();
  document.body.classList.add("ready");
}

onChange(form, filter, 150);
byId("more").addEventListener("click", more);
begin().catch(say);
