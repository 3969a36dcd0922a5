const filters = document.querySelector(".filters"), chosen = document.querySelector(".chosen");
const cards = [...document.querySelectorAll(".card")];
function show() {
  const picked = [...filters.querySelectorAll(":checked")].filter((radio) => radio.value);
  const order = picked.find((radio) => radio.name === "order")?.value;
  const choices = picked.filter((radio) => radio.name !== "order");
  for (const card of cards)
    card.hidden = choices.some(({ name, value }) => card.dataset[name] !== value);
  const rank = (card) => order ? JSON.parse(card.dataset.orders)[order] : 0;
  document.querySelector(".cards").append(...[...cards].sort((a, b) => rank(a) - rank(b)));
  chosen.hidden = !choices.length;
  chosen.querySelector("code").textContent =
    [chosen.dataset.command, ...choices.map((radio) => radio.dataset.words)].join(" ");
}
filters.hidden = false;
filters.addEventListener("change", show);
addEventListener("pageshow", show);  // a browser that comes back restores the buttons
