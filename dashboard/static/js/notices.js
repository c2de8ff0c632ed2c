// What is wrong, in sentences, at the top of the page.
import { byId, element } from "./dom.js";
import { clock } from "./format.js";

const MEANS = {
  sampler: "No new samples come.",
  learner: "Predictions are not answered, and nothing is learnt.",
};

let shown = "";
let told = null;

// What a button brought about; it stays until the next one.
export function tell(said, kind) {
  told = { said, kind, dismiss: true };
}

export function notices(state, connected) {
  const found = [...problems(state, connected)];
  if (told) found.unshift(told);
  const key = JSON.stringify(found);
  if (key === shown) return; // what is said again is not read aloud again
  shown = key;
  byId("notices").replaceChildren(...found.map((notice) => {
    const made = element("div", { className: `notice ${notice.kind}` }, element("span", {}, notice.said));
    if (notice.dismiss) made.append(element("button", { type: "button", className: "small", onclick: () => { told = null; notices(state, connected); } }, "Dismiss"));
    return made;
  }));
}

function* problems(state, connected) {
  if (!connected && Object.keys(state).length === 0) {
    yield { kind: "", said: "Waiting for the page's server…" };
    return;
  }
  if (!connected) {
    yield { kind: "bad", said: "The page's server does not answer. What is shown is old; it goes on by itself when `bodyschema view` runs again." };
    return;
  }
  for (const name of ["sampler", "learner"]) {
    const process = state[name];
    if (!process) continue;
    if (process.problem) yield { kind: "bad", said: `What the ${name} says is not understood: ${process.problem}` };
    if (process.answers) for (const said of process.status.health) yield { kind: "", said: `${name}: ${said}` };
    else {
      const since = process.heard ? `has not answered since ${clock(process.heard)}` : `does not answer on ${process.endpoint}`;
      yield { kind: "bad", said: `The ${name} ${since}. ${MEANS[name]} Start it with \`bodyschema run ${name}\`, or both with \`bodyschema run\`; this page goes on by itself.` };
    }
  }
}
