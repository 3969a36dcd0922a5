// The page of one scene: 3D on one side, the same view by every engine on the other.

import { Matrix4, Vector3 } from "./three/three.module.min.js";
import { ask, askJson, byId, copy, download, element, say, some } from "./ask.js";
import { Edits } from "./edits.js";
import { Orbit } from "./orbit.js";
import { Pictures } from "./pictures.js";
import { Stage } from "./stage.js";

const canvas = byId("stage");
const now = { view: 0, fov: 40 };

const orbit = new Orbit(canvas, () => {
  now.view = null;
  byId("view").value = "";
  moved();
});
let stage, pictures, edits;

function moved() {
  stage.look(orbit.pose, now.fov);
  pictures.refresh();
}

function takeView(view) {
  const { c2w, fov } = stage.head.cameras[view];
  const pose = new Matrix4().set(...c2w);
  const eye = new Vector3().setFromMatrixPosition(pose);
  const ahead = new Vector3().setFromMatrixColumn(pose, 2).negate();
  const middle = stage.bounds.isEmpty() ? new Vector3() : stage.bounds.getCenter(new Vector3());
  const far = Math.max(0.2, middle.sub(eye).dot(ahead));
  Object.assign(now, { view, fov });
  orbit.take(pose, eye.addScaledVector(ahead, far));
  byId("view").value = view;
  moved();
}

function wanted() {
  const e = orbit.pose.elements; // column by column
  const c2w = [0, 1, 2, 3].flatMap((row) => [e[row], e[4 + row], e[8 + row], e[12 + row]]);
  return {
    c2w, fov: now.fov, view: now.view, edits: edits.told,
    resolution: Number(byId("width").value), error_db: Number(byId("goal").value),
  };
}

const look = () => ({ ev: Number(byId("ev").value), tone: byId("tone").value });

function developed() {
  byId("ev-shown").textContent = `${look().ev.toFixed(2)} stops`;
  stage.develop(look().ev, look().tone);
  pictures.show();
}

function fillChoices(facts) {
  const widths = new Set([64, 128, 256, 384, 512, 768, 1024]);
  if (facts.target_px) widths.add(facts.target_px);
  for (const width of [...widths].sort((a, b) => a - b)) {
    const text = width === facts.target_px ? `${width} pixels, as the target` : `${width} pixels`;
    byId("width").append(new Option(text, width));
  }
  byId("width").value = facts.target_px || 256;
  byId("view").append(new Option("free", ""));
  stage.head.cameras.forEach((_, view) => byId("view").append(new Option(`view ${view}`, view)));
  for (const [form, means] of facts.exports) {
    byId("form").append(new Option(`${form}: ${means}`, form));
  }
}

function describe(facts) {
  document.title = `${facts.name} – Trilight`;
  byId("name").textContent = facts.name;
  byId("facts").textContent = [some(facts.triangles, "triangle"), some(facts.lights, "light"),
    some(facts.materials, "material"), some(facts.textures, "texture"),
    some(facts.views, "camera"), facts.template].filter(Boolean).join(", ");
  byId("notes").append(...facts.notes.map((note) => element("li", {}, note)));
  byId("note-part").hidden = !facts.notes.length;
  byId("back").hidden = !location.pathname.includes("/scene/");
}

async function save() {
  const form = byId("form").value;
  byId("exported").textContent = "Writing …";
  await pictures.rest();
  try {
    const answer = await ask("api/export", { form, edits: edits.told });
    const blob = await answer.blob();
    saveAs(`scene${form}`, blob);
    const lost = answer.headers.get("X-Lost");
    byId("exported").textContent = `Saved scene${form}, ${(blob.size / 1e3).toFixed(0)} kB`
      + (lost ? `; it cannot hold ${lost}.` : ".");
  } catch (error) {
    byId("exported").textContent = error.message;
  }
  pictures.resume();
}

function saveAs(name, blob) {
  const url = URL.createObjectURL(blob);
  download(name, url);
  setTimeout(() => URL.revokeObjectURL(url), 60000);
}

function listen() {
  byId("view").addEventListener("change", (event) => {
    if (event.target.value !== "") takeView(Number(event.target.value));
  });
  byId("home").addEventListener("click", () => takeView(Number(byId("view").value || 0)));
  for (const name of ["ev", "tone"]) byId(name).addEventListener("input", developed);
  for (const name of ["width", "goal"]) {
    byId(name).addEventListener("change", () => pictures.refresh());
  }
  byId("all").addEventListener("change", () => pictures.resume());
  byId("error").addEventListener("change", () => pictures.show());
  byId("export").addEventListener("click", save);
  byId("save-picture").addEventListener("click", () => download("view.png", byId("picture").src));
  byId("save-camera").addEventListener("click", () => {
    saveAs("camera.json", new Blob([pictures.told.get(pictures.engine).camera]));
  });
  byId("copy").addEventListener("click", () => copy(byId("command"), byId("copy")));
  let pressed = [0, 0];
  canvas.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; });
  canvas.addEventListener("click", (event) => {
    if (Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > 4) return;
    const chosen = stage.at(event.clientX, event.clientY);
    if (chosen) edits.choose(chosen);
  });
}

async function begin() {
  const facts = await askJson("api/scene");
  describe(facts);
  stage = new Stage(canvas);
  stage.load(await (await ask("api/scene.bin")).arrayBuffer());
  if (stage.head.sky) stage.sky(await (await ask("api/sky.bin")).arrayBuffer());
  edits = new Edits(stage.head, (changes) => {
    stage.edit(changes);
    pictures.refresh();
  });
  pictures = new Pictures(facts.engines, wanted, look);
  fillChoices(facts);
  listen();
  developed();
  takeView(0);
  window.viewer = { stage, orbit, pictures, edits, now };
  document.body.classList.add("ready");
}

begin().catch(say);
