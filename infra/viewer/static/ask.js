// HTTP requests to the server of this page, and messages of its errors.

export async function ask(path, body) {
  const options = body === undefined ? {} : {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body),
  };
  let answer;
  try {
    answer = await fetch(path, options);
  } catch {
    throw new Error("The server does not answer: has `trilight view` ended?");
  }
  if (answer.ok) return answer;
  const told = await answer.json().catch(() => ({ error: `The server answered ${answer.status}.` }));
  throw new Error(told.error);
}

export async function askJson(path, body) {
  return (await ask(path, body)).json();
}

export const byId = (name) => document.getElementById(name);

export const some = (count, what) => `${count.toLocaleString("en")} ${what}${count === 1 ? "" : "s"}`;

// Says how many are shown, and offers the others.
export function page(shown, matching, all) {
  byId("count").textContent = `${matching.toLocaleString("en")} of ${all}`
    + (shown < matching ? `, the first ${shown} shown` : "");
  byId("more").hidden = shown >= matching;
}

export function say(error) {
  const place = document.getElementById("mistake");
  place.textContent = error ? String(error.message || error) : "";
  place.hidden = !error;
}

export function element(tag, attributes = {}, ...content) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name in made && name !== "list") made[name] = value; else made.setAttribute(name, value);
  }
  made.append(...content);
  return made;
}

export async function copy(code, button) {
  try {
    await navigator.clipboard.writeText(code.textContent);
    button.textContent = "Copied";
  } catch {
    getSelection().selectAllChildren(code);
    button.textContent = "Selected: press Ctrl-C";
  }
  setTimeout(() => { button.textContent = "Copy"; }, 2500);
}

export function download(name, url) {
  element("a", { href: url, download: name }).click();
}

// Acts a moment after the last change of a form, and once it is reset.
export function onChange(form, act, calmMs) {
  let calm;
  form.addEventListener("input", () => {
    clearTimeout(calm);
    calm = setTimeout(act, calmMs);
  });
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("reset", () => setTimeout(act));
}

// What was chosen in a form before its page was left; a choice may come later than the page.
export class KeptForm {
  constructor(form) {
    this.form = form;
    this.left = new Map(JSON.parse(sessionStorage.getItem(location.pathname) || "[]"));
    for (const done of ["input", "reset"]) form.addEventListener(done, () => this.left.clear());
  }

  restore() {
    for (const [name, value] of this.left) {
      const field = this.form.elements[name];
      if (field.options && ![...field.options].some((each) => each.value === value)) continue;
      field.value = value;
      this.left.delete(name);
    }
  }

  keep() {
    if (this.left.size) return;
    sessionStorage.setItem(location.pathname, JSON.stringify([...new FormData(this.form)]));
  }
}

export const sleep = (ms) => new Promise((done) => setTimeout(done, ms));
