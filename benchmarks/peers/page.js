for (const button of document.querySelectorAll("[data-toggle]")) {
  const key = button.dataset.toggle;
  const lines = [...document.querySelectorAll("[data-model]")];
  button.addEventListener("click", () => {
    const shown = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(shown));
    for (const line of lines) if (line.dataset.model === key) line.classList.toggle("off", !shown);
  });
  const dim = (on) => {
    for (const line of lines) line.classList.toggle("dim", on && line.dataset.model !== key);
  };
  button.addEventListener("mouseenter", () => dim(true));
  button.addEventListener("mouseleave", () => dim(false));
}
