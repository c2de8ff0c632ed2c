const lines = [...document.querySelectorAll("[data-model]")];

function alone(element, key) {
  const show = (on) => {
    for (const line of lines) {
      const its = line.dataset.model === key;
      line.classList.toggle("dim", on && !its);
      line.classList.toggle("lit", on && its);
    }
  };
  for (const [event, on] of [["mouseenter", true], ["mouseleave", false], ["focus", true], ["blur", false]])
    element.addEventListener(event, () => show(on));
}

for (const line of lines) alone(line, line.dataset.model);
for (const button of document.querySelectorAll("[data-toggle]")) {
  const key = button.dataset.toggle;
  alone(button, key);
  button.addEventListener("click", () => {
    const shown = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(shown));
    for (const line of lines) if (line.dataset.model === key) line.classList.toggle("off", !shown);
  });
}
