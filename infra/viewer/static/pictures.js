// Pictures by every renderer, one after another; leaving the page cancels them.

import { ask, askJson, element, say, sleep } from "./ask.js";

const SETTLED_MS = 250;
const JUDGES = ["target", "traced"];
const isPass = (name) => name.startsWith("pass-");
const SAMPLES = "samples-";
const FIRST_RUNGS = ["samples-4", "samples-16"];

export class Pictures {
  // `wanted` returns the request without its engine; `look` the exposure and tone map.
  constructor(engines, wanted, look) {
    this.engines = engines;
    this.wanted = wanted;
    this.look = look;
    this.told = new Map();
    this.generation = 0;
    this.cards = new Map();
    this.engine = engines[0].name; // path traced: its previews come before any other image
    this.#fill("ways", engines.filter((each) => !isPass(each.name)));
    this.#fill("passes", engines.filter((each) => isPass(each.name)));
    this.#fillRungs(engines.filter((each) => each.name.startsWith(SAMPLES)));
    document.addEventListener("visibilitychange", () => this.#hidden());
  }

  // Something about the pictures themselves changed: all are made anew once it is calm.
  async refresh() {
    const mine = ++this.generation;
    this.told.clear();
    for (const [name, card] of this.cards) if (!isPass(name)) card.classList.add("old");
    document.getElementById("picture").classList.add("old");
    await sleep(SETTLED_MS);
    if (mine === this.generation) await this.#makeAll(mine);
  }

  choose(name) {
    this.engine = name;
    for (const [each, card] of this.cards) {
      card.setAttribute("aria-checked", String(each === name));
      card.tabIndex = each === name ? 0 : -1;
    }
    this.show();
    if (!this.told.has(name)) this.resume();
  }

  resume() {
    this.#makeAll(++this.generation);
  }

  // Shows what is there with the look of now.
  show() {
    for (const [name, told] of this.told) this.#showCard(name, told);
    this.#showPicture();
  }

  async #makeAll(mine) {
    const all = document.getElementById("all").checked;
    const rungs = [...this.cards.keys()].filter((name) => name.startsWith(SAMPLES));
    const others = ["hits", "network", "tokens", "direct", ...rungs, "traced"];
    const names = new Set(["target", this.engine, ...others]); // the target is stored: no wait
    try {
      for (const name of names) {
        if (name !== this.engine && !(all && this.#isShown(name))) continue;
        const before = this.told.get(name);
        if (before && ["done", "failed"].includes(before.state)) continue;
        if (!await this.#make(name, mine)) return;
      }
      say("");
    } catch (error) {
      if (mine === this.generation) say(error);
    }
  }

  // Returns whether the page still wants what follows.
  async #make(name, mine) {
    const card = this.cards.get(name);
    card.classList.add("busy");
    try {
      let { id } = await askJson("api/picture", { ...this.wanted(), engine: name });
      for (let after = 0; ;) {
        const told = await askJson(`api/picture/${id}?after=${after}`);
        if (mine !== this.generation) return false;
        after = told.version;
        this.told.set(name, told);
        this.#showCard(name, told);
        if (name === this.engine) this.#showPicture();
        if (JUDGES.includes(name) && told.floor_db != null || told.state === "done") {
          await this.#judgeAnew(mine);
        }
        if (told.state === "done" || told.state === "failed") return true;
        if (told.state === "cancelled") return false;
      }
    } finally {
      card.classList.remove("busy");
    }
  }

  // Pictures that were made before there was anything to judge them by.
  async #judgeAnew(mine) {
    for (const [name, { id, shown }] of [...this.told]) {
      if (!shown || JUDGES.includes(name) && name !== "traced" || isPass(name)) continue;
      const told = await askJson(`api/picture/${id}`);
      if (mine !== this.generation) return;
      this.told.set(name, told);
      this.#showCard(name, told);
    }
    this.#showPicture();
  }

  #url(told, shows) {
    const { ev, tone } = this.look();
    return `api/shown/${told.id}?version=${told.version}&ev=${ev}&tone=${tone}&as=${shows}`;
  }

  #showCard(name, told) {
    const card = this.cards.get(name);
    card.querySelector("small").textContent = told.error || figures(told);
    if (!told.shown) return;
    const image = card.querySelector("img");
    if (image) swap(image, this.#url(told, "picture"));
    card.classList.remove("old");
  }

  #showPicture() {
    const told = this.told.get(this.engine);
    const image = document.getElementById("picture");
    const waiting = document.getElementById("waiting");
    const facts = this.engines.find((each) => each.name === this.engine);
    document.getElementById("picture-title").textContent = facts.title;
    waiting.textContent = (told && told.error) || "Computing …";
    waiting.hidden = Boolean(told && told.shown);
    const { ev, tone } = this.look();
    const developed = (ev ? ` --exposure ${ev}` : "") + (tone === "plain" ? "" : ` --tone-map ${tone}`);
    document.getElementById("command-part").hidden = !(told && told.shown);
    const command = document.getElementById("command");
    command.parentElement.hidden = !(told && told.command);
    command.textContent = told ? told.command + developed : "";
    document.getElementById("figures").textContent = told ? progress(told) : "";
    const wantsError = document.getElementById("error").checked;
    const judged = told && told.agreement_db != null;
    const lines = [facts.means];
    if (told) lines.push(told.says, ...(told.notes || []));
    if (wantsError && told && !judged) lines.unshift(noError(told, this.engine));
    if (wantsError && judged) {
      lines.unshift(`Error against ${truth(told)}: black is none, white ${told.error_white} log10.`);
    }
    const text = lines.filter(Boolean).map((line) => line.replace(/\.?$/, ".")).join(" ");
    document.getElementById("says").textContent = text;
    if (!told || !told.shown) return;
    image.alt = `${facts.title}: ${figures(told)}`;
    swap(image, this.#url(told, wantsError && judged ? "error" : "picture"));
  }

  #fill(place, engines) {
    const group = document.getElementById(place);
    for (const { name, title, means } of engines) {
      const card = element("button", { type: "button", title: means, className: "card" },
        ...(isPass(name) ? [] : [element("span", { className: "thumb" }, element("img", { alt: "" }))]),
        element("b", {}, title), element("small", {}, ""));
      card.setAttribute("role", "radio");
      card.setAttribute("aria-checked", String(name === this.engine));
      card.dataset.engine = name;
      card.tabIndex = name === this.engine ? 0 : -1;
      card.addEventListener("click", () => this.choose(name));
      card.addEventListener("keydown", (event) => this.#step(event, engines, name));
      this.cards.set(name, card);
      group.append(card);
    }
    if (isPass(engines[0].name)) group.firstChild.tabIndex = 0;
  }

  // A box for each rung of few samples: only those that are ticked are shown and made.
  #fillRungs(engines) {
    const group = document.getElementById("rungs");
    group.hidden = !engines.length;
    for (const { name } of engines) {
      const spp = name.slice(SAMPLES.length);
      const box = element("input", { type: "checkbox", checked: FIRST_RUNGS.includes(name) });
      box.dataset.rung = name;
      box.addEventListener("change", () => this.#filter(name, box.checked));
      this.cards.get(name).hidden = !box.checked;
      group.append(element("label", { className: "check" }, box, ` ${spp}`));
    }
  }

  #filter(name, shown) {
    this.cards.get(name).hidden = !shown;
    if (!shown && this.engine === name) this.choose("traced");
    this.resume();
  }

  #isShown(name) {
    return this.cards.has(name) && !this.cards.get(name).hidden;
  }

  #step(event, engines, name) {
    const steps = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 };
    if (!(event.key in steps)) return;
    event.preventDefault();
    const names = engines.map((each) => each.name).filter((each) => this.#isShown(each));
    const next = names[(names.indexOf(name) + steps[event.key] + names.length) % names.length];
    this.choose(next);
    this.cards.get(next).focus();
  }

  // Leaves the processor to others.
  rest() {
    this.generation += 1;
    return ask("api/rest", {}).catch(() => {});
  }

  #hidden() {
    if (document.hidden) this.rest();
    else this.resume();
  }
}

function swap(image, url) {
  if (image.dataset.url === url) return;
  image.dataset.url = url;
  const next = new Image();
  next.onload = () => {
    if (image.dataset.url !== url) return;
    image.src = url;
    image.classList.remove("old");
  };
  next.src = url;
}

const seconds = (value) => (value < 0.995 ? value.toPrecision(2) : value.toFixed(1));

function figures(told) {
  const parts = [];
  if (told.core_s != null) parts.push(`${seconds(told.core_s)} CPU s`);
  if (told.spp) parts.push(`${told.spp} spp`);
  if (told.floor_db != null) {
    const probably = told.expected_db == null ? "" : `, probably ${told.expected_db.toFixed(1)}`;
    parts.push(`stated ${told.floor_db.toFixed(1)} dB${probably}`);
  }
  if (told.agreement_db != null) parts.push(`${told.agreement_db.toFixed(1)} dB to ${truth(told)}`);
  return parts.join(", ");
}

function progress(told) {
  const parts = [figures(told)];
  if (told.scene_core_s) parts.push(`+ ${seconds(told.scene_core_s)} CPU s for the scene`);
  if (told.state !== "done" && told.sampling) {
    parts.push(`at ${told.sampling.spp} of about ${told.sampling.expected_spp} samples`);
  }
  const stated = (told.prices || []).filter((price) => price.floor_db != null);
  if (stated.length > 1) {
    parts.push(`stated error: ${stated.map((price) => price.floor_db.toFixed(1)).join(" → ")} dB`);
  }
  return parts.filter(Boolean).join("; ");
}

const truth = (told) => (told.truth === "target" ? "the target" : "path traced");

function noError(told, engine) {
  if (engine === "traced" || engine === "target") return "The others are judged by this image";
  if (engine.startsWith("pass-")) return "A pass has no error: it is exact";
  return "The error comes once there is a target or a path traced image";
}
