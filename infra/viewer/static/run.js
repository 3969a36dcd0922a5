// The page of a training run: its validation pictures by step, beside the curves.

import { askJson, element, say, sleep } from "./ask.js";

const byId = (name) => document.getElementById(name);
const [WIDE, HIGH, LEFT, LOW] = [360, 150, 44, 20];
const LOOK_AGAIN_MS = 10000;
const PLAY_MS = 600;
let facts = { steps: [] };

function drawn(tag, attributes, text = "") {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.textContent = text;
  return made;
}

function chart({ name, points }) {
  const steps = points.map(([step]) => step);
  const values = points.map(([, value]) => value);
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const last = Math.max(...steps, 1);
  const x = (step) => LEFT + (step / last) * (WIDE - LEFT - 6);
  const y = (value) => 8 + (1 - (value - low) / (high - low || 1)) * (HIGH - LOW - 14);
  const line = points.map(([step, value], at) => `${at ? "L" : "M"}${x(step)} ${y(value)}`).join("");
  const svg = drawn("svg", { viewBox: `0 0 ${WIDE} ${HIGH}`, role: "img",
    "aria-label": `${name}: ${values[0].toPrecision(3)} to ${values.at(-1).toPrecision(3)}` });
  svg.append(
    drawn("line", { x1: LEFT, x2: WIDE, y1: HIGH - LOW, y2: HIGH - LOW }),
    drawn("text", { x: 0, y: y(high) + 4 }, high.toPrecision(3)),
    drawn("text", { x: 0, y: y(low) }, low.toPrecision(3)),
    drawn("text", { x: LEFT, y: HIGH - 5 }, "0"),
    drawn("text", { x: WIDE, y: HIGH - 5, "text-anchor": "end" }, `step ${last}`),
    drawn("path", { d: line }));
  const now = drawn("line", { class: "now", y1: 4, y2: HIGH - LOW });
  now.dataset.last = last;
  svg.append(now);
  return element("figure", {}, element("figcaption", {}, name), svg);
}

function showStep() {
  const step = facts.steps[Number(byId("step").value)];
  if (step === undefined) {
    byId("caption").textContent = "None yet: they come with the first validation.";
    return;
  }
  byId("step-shown").textContent = step.toLocaleString("en");
  byId("step").setAttribute("aria-valuetext", `step ${step}`);
  byId("picture").src = `api/step/${step}`;
  byId("picture").alt = `validation views at step ${step}`;
  byId("caption").textContent = `step ${step}`;
  for (const line of document.querySelectorAll(".now")) {
    const x = LEFT + (Math.min(step, line.dataset.last) / line.dataset.last) * (WIDE - LEFT - 6);
    line.setAttribute("x1", x);
    line.setAttribute("x2", x);
  }
}

async function play() {
  const button = byId("play");
  const going = button.getAttribute("aria-pressed") !== "true";
  button.setAttribute("aria-pressed", String(going));
  button.textContent = going ? "Stop" : "Play";
  while (button.getAttribute("aria-pressed") === "true") {
    byId("step").value = (Number(byId("step").value) + 1) % Math.max(1, facts.steps.length);
    showStep();
    await sleep(PLAY_MS);
  }
}

// A run that goes on gets new pictures; whoever stands at the last one sees them come.
async function watch() {
  for (;;) {
    const atEnd = Number(byId("step").value) >= facts.steps.length - 1;
    facts = await askJson("api/run");
    document.title = `${facts.name} – Trilight`;
    byId("name").textContent = facts.name;
    byId("facts").textContent = `${facts.facts.steps} of ${facts.facts["steps planned"]} steps${
      facts.facts.finished ? ", finished" : ""}`;
    byId("step").max = Math.max(0, facts.steps.length - 1);
    if (atEnd) byId("step").value = facts.steps.length - 1;
    byId("target-part").hidden = !facts.target;
    if (facts.target && !byId("target").src) byId("target").src = "api/step/target";
    byId("curves").replaceChildren(...facts.curves.map(chart));
    byId("run").replaceChildren(...Object.entries(facts.facts).flatMap(([name, value]) =>
      [element("dt", {}, name), element("dd", {}, String(value))]));
    showStep();
    document.body.classList.add("ready");
    if (facts.facts.finished) return;
    await sleep(LOOK_AGAIN_MS);
  }
}

byId("step").addEventListener("input", showStep);
byId("play").addEventListener("click", play);
watch().catch(say);
