// Lamps that are moved and materials that are changed, and what the page says of them.

import { byId } from "./ask.js";
import { Color } from "./three/three.module.min.js";

const encoded = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);
const MOST_OF_ONE = 12; // materials of one thing that are listed one by one

export class Edits {
  constructor(head, changed) {
    this.head = head;
    this.changed = changed;
    this.lamps = {};
    this.materials = {};
    this.#begin();
  }

  // What the server is told; equal changes are told equally.
  get told() {
    return this.empty ? {} : { lamps: this.lamps, materials: this.materials };
  }

  get empty() {
    return !Object.keys(this.lamps).length && !Object.keys(this.materials).length;
  }

  choose({ object, material }) {
    if (this.head.objects[object].kind === "emitter") {
      byId("lamp").value = object;
      this.#showLamp();
    } else {
      const holds = ({ value }) => value.split(" ").includes(String(material));
      byId("material").value = [...byId("material").options].find(holds)?.value ?? "";
      this.#showMaterial();
    }
  }

  #begin() {
    for (const lamp of this.head.lamps) {
      byId("lamp").append(new Option(this.head.objects[lamp.object].name, lamp.object));
    }
    byId("lamp-part").disabled = !this.head.lamps.length;
    const worn = new Map();
    for (const group of this.head.groups) {
      const name = this.head.objects[group.object].name;
      if (this.#emits(group.material)) continue;
      worn.set(group.material, worn.has(group.material) ? `${worn.get(group.material)} …` : name);
    }
    const rows = Map.groupBy(worn.keys(), (row) => worn.get(row));
    for (const [name, all] of rows) {
      const short = name.replace(/( …)+$/, " and others").slice(0, 50);
      const entries = all.length > MOST_OF_ONE ? [all] : all.map((row) => [row]);
      for (const entry of entries) {
        const label = entry.length > 1 ? `${short}: ${entry.length} materials at once` : `${entry[0]}: ${short}`;
        byId("material").append(new Option(label, entry.join(" ")));
      }
    }
    const far = Math.max(1, ...this.head.lamps.flatMap((lamp) => lamp.centre.map(Math.abs)));
    for (const input of document.querySelectorAll(".move")) {
      input.min = -far;
      input.max = far;
      input.step = far / 100;
      input.addEventListener("input", () => this.#moved());
    }
    byId("gain").addEventListener("input", () => this.#moved());
    byId("lamp").addEventListener("change", () => this.#showLamp());
    byId("material").addEventListener("change", () => this.#showMaterial());
    byId("diffuse").addEventListener("input", () => this.#dressed("diffuse"));
    byId("specular").addEventListener("input", () => this.#dressed("specular"));
    byId("roughness").addEventListener("input", () => this.#dressed("roughness"));
    byId("undo").addEventListener("click", () => this.#undo());
    this.#showLamp();
    this.#showMaterial();
  }

  #emits(row) {
    return this.head.materials[row].emission.some((value) => value > 0);
  }

  #moved() {
    const move = [...document.querySelectorAll(".move")].map((input) => Number(input.value));
    const gain = 2 ** Number(byId("gain").value);
    const row = byId("lamp").value;
    if (gain === 1 && move.every((value) => value === 0)) delete this.lamps[row];
    else this.lamps[row] = { move, gain };
    this.#showLamp();
    this.#tell();
  }

  #showLamp() {
    const { move = [0, 0, 0], gain = 1 } = this.lamps[byId("lamp").value] || {};
    document.querySelectorAll(".move").forEach((input, axis) => {
      input.value = move[axis];
      input.previousElementSibling.textContent = `${signed(move[axis], 2)} m`;
    });
    byId("gain").value = Math.log2(gain);
    byId("gain-shown").textContent = `× ${gain.toPrecision(2)}`;
  }

  #dressed(which) {
    for (const row of byId("material").value.split(" ")) this.#dressedRow(row, which);
    this.#showMaterial();
    this.#tell();
  }

  #dressedRow(row, which) {
    const change = { ...this.materials[row] };
    if (which === "diffuse") change.diffuse = fromHex(byId("diffuse").value);
    if (which === "roughness") change.roughness = Number(byId("roughness").value);
    if (which === "specular") change.specular = Array(3).fill(Number(byId("specular").value));
    const { diffuse, specular } = { ...this.head.materials[row], ...change };
    const bounded = specular.map((value, axis) => Math.min(value, 1 - diffuse[axis]));
    if (bounded.some((value, axis) => value < specular[axis])) change.specular = bounded;
    this.materials[row] = change;
  }

  #showMaterial() {
    const [row] = byId("material").value.split(" ");
    if (row === "") return;
    const now = { ...this.head.materials[row], ...this.materials[row] };
    byId("diffuse").value = toHex(now.diffuse);
    const mean = now.specular.reduce((sum, value) => sum + value, 0) / 3;
    byId("specular").value = mean;
    byId("specular-shown").textContent = mean.toFixed(2);
    byId("roughness").value = now.roughness;
    byId("roughness-shown").textContent = now.roughness.toFixed(2);
  }

  #undo() {
    this.lamps = {};
    this.materials = {};
    this.#showLamp();
    this.#showMaterial();
    this.#tell();
  }

  #tell() {
    const lamps = Object.keys(this.lamps).length;
    const materials = Object.keys(this.materials).length;
    byId("changes").textContent = this.empty ? "Nothing is changed."
      : `Changed: ${lamps} of the lights, ${materials} of the materials. The file stays as it is.`;
    byId("undo").disabled = this.empty;
    this.changed({ lamps: this.lamps, materials: this.materials });
  }
}

const signed = (value, digits) => `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(digits)}`;

function toHex(colour) {
  const digits = colour.map((value) =>
    Math.round(255 * Math.min(1, Math.max(0, encoded(value)))).toString(16).padStart(2, "0"));
  return `#${digits.join("")}`;
}

const fromHex = (text) => new Color(text).toArray().map((value) => Math.round(value * 1e5) / 1e5);
