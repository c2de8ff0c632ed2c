// Numbers as a person reads them.

export function mm(metres) {
  if (metres === null || metres === undefined || !Number.isFinite(metres)) return "–";
  const value = 1e3 * metres;
  return `${value.toFixed(value >= 100 ? 0 : value >= 1 ? 1 : value >= 0.1 ? 2 : 3)} mm`;
}

export function whole(number) {
  return number === null || number === undefined ? "–" : Math.round(number).toLocaleString("en");
}

export function joint(value, slides) {
  const shown = slides ? value : (180 * value) / Math.PI;
  return `${shown > 0 ? "+" : shown < 0 ? "−" : ""}${Math.abs(shown).toFixed(slides ? 3 : 0)}${slides ? " m" : "°"}`;
}

export function milliseconds(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  const value = 1e3 * seconds;
  return `${value.toFixed(value >= 10 ? 0 : 1)} ms`;
}

export function span(seconds) {
  if (seconds < 90) return `${seconds.toFixed(seconds < 10 ? 1 : 0)} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  return `${(seconds / 3600).toFixed(1)} h`;
}

export function clock(secondsSince1970) {
  return new Date(1e3 * secondsSince1970).toLocaleTimeString("en-GB");
}

// What changed, in words; the learner's kinds are tool, camera, joint NAME, other and undecided.
export function kindOfChange(kind) {
  if (kind === "tool") return "tool changed";
  if (kind === "camera") return "camera moved";
  if (kind?.startsWith("joint ")) return `zero of ${kind.slice(6)} moved`;
  return kind ? "something changed" : "learning began again";
}

export function changed({ kind, told }) {
  return `${kindOfChange(kind)}${told ? " (told)" : kind ? " (found)" : ""}`;
}

export function words(name) {
  return name.replaceAll("_", " ");
}

// The largest of 1, 2 and 5 times a power of ten that is no larger.
export function roundDown(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * ([5, 2].find((digit) => value >= digit * power) ?? 1);
}
