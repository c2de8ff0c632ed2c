// The buttons: what they ask for, and when they can.
import { byId, text } from "./dom.js";
import { changed, whole } from "./format.js";
import { tell } from "./notices.js";

const VERDICTS = { explained: "Explained.", nothing_found: "Nothing found.", undecided: "Undecided.", unexplained: "Not all explained." };

export class Actions {
  constructor(changed) {
    this.changed = changed;
    this.state = {};
    byId("pause").addEventListener("click", () => this.command("sampler", this.paused() ? "resume" : "pause"));
    for (const [id, command] of [["tool", "tool_changed"], ["rollback", "rollback"]]) {
      byId(id).addEventListener("click", () => byId(`${id}-dialog`).showModal());
      byId(`${id}-dialog`).addEventListener("close", (event) => {
        if (event.target.returnValue === "yes") this.command("learner", command);
        event.target.returnValue = "no";
      });
    }
    byId("diagnose").addEventListener("click", () => this.ask("POST", "api/diagnosis"));
    byId("diagnosis-stop").addEventListener("click", () => this.ask("DELETE", "api/diagnosis"));
  }

  paused() {
    return this.state.sampler?.status?.state === "paused";
  }

  async command(process, command) {
    const reply = await this.ask("POST", "api/command", { process, command });
    if (reply) tell(`${process}: ${reply.message}.`, "good");
    this.changed();
  }

  async ask(method, address, body) {
    try {
      const headers = body ? { "Content-Type": "application/json" } : {};
      const answer = await fetch(address, { method, headers, body: body && JSON.stringify(body) });
      const said = answer.status === 204 ? {} : await answer.json();
      if (answer.ok) return said;
      tell(said.error, "bad");
    } catch {
      tell("The page's server does not answer: nothing was done.", "bad");
    }
    this.changed();
    return null;
  }

  update(state, connected) {
    this.state = state;
    const { sampler, learner, diagnosis } = state;
    const change = learner?.status?.last_change;
    if (change) text("rollback-of", `The last change: ${changed({ kind: change.kind, told: !change.found })}, from sample ${change.first_seq} on. What was learnt since is dropped; the samples stay stored.`);
    const running = ["copying", "running"].includes(diagnosis?.state);
    const can = { pause: sampler?.answers && ["running", "paused"].includes(sampler.status.state), tool: learner?.answers, rollback: learner?.answers && change?.can_roll_back, diagnose: sampler?.answers && !running };
    for (const [id, possible] of Object.entries(can)) byId(id).disabled = !(connected && possible);
    text("pause", this.paused() ? "Resume" : "Pause");
    text("diagnose", running ? "Diagnosing…" : "Diagnose now");
    this.diagnosis(diagnosis, running);
  }

  diagnosis(diagnosis, running) {
    byId("diagnosis-section").hidden = !diagnosis?.number;
    if (!diagnosis?.number) return;
    byId("diagnosis-stop").hidden = !running;
    const of = diagnosis.pairs ? ` of the newest ${whole(diagnosis.pairs)} samples` : "";
    const said = {
      copying: "Copying samples from the sampler…",
      running: `Diagnosis${of}: ${diagnosis.said}…`,
      done: `${VERDICTS[diagnosis.verdict] ?? ""} ${diagnosis.said} (Diagnosis${of}.)`,
      failed: `The diagnosis failed: ${diagnosis.said}`,
      stopped: "The diagnosis was stopped.",
    };
    text("diagnosis", said[diagnosis.state]);
    byId("report").hidden = diagnosis.report === null;
    text("report", diagnosis.report === diagnosis.number ? "Open the report" : "Open the report of the diagnosis before");
  }
}
