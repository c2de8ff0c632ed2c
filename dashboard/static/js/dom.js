// Small helpers around the document. Text from outside goes in as text, never as HTML.

const SVG = "http://www.w3.org/2000/svg";

export const byId = (id) => document.getElementById(id);

export function text(id, value) {
  const element = byId(id);
  if (element.textContent !== value) element.textContent = value;
}

export function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

// A bar over a track: `from` and `to` are shares of its length.
export function bar(from, to, track = false) {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("aria-hidden", "true");
  svg.setAttribute("preserveAspectRatio", "none");
  if (track) svg.append(rectangle(0, 1, "track"));
  svg.append(rectangle(from, to, "seen"));
  return svg;
}

export function row(...cells) {
  const made = document.createElement("tr");
  for (const cell of cells) {
    if (cell instanceof HTMLTableCellElement) made.append(cell);
    else made.append(element("td", {}, cell));
  }
  return made;
}

function rectangle(from, to, name) {
  const made = document.createElementNS(SVG, "rect");
  const values = { x: `${100 * from}%`, width: `${100 * Math.max(to - from, 0.004)}%`, height: "100%", rx: 2, class: name };
  for (const [key, value] of Object.entries(values)) made.setAttribute(key, value);
  return made;
}
