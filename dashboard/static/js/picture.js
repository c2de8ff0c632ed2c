// The cameras' picture with detections, asked for while it can be seen.
import { byId, text } from "./dom.js";

const EVERY_MS = 1000;
const REST_MS = 10000;

// The page's policy allows data: and no blob: addresses.
function dataUrl(blob) {
  return new Promise((resolve, reject) => {
    const reader = new FileReader();
    reader.onload = () => resolve(reader.result);
    reader.onerror = reject;
    reader.readAsDataURL(blob);
  });
}

export class Picture {
  constructor() {
    this.image = byId("picture");
    this.section = byId("picture-section");
    this.follow();
  }

  async follow() {
    const shown = !document.hidden && (await this.next());
    setTimeout(() => this.follow(), shown ? EVERY_MS : REST_MS);
  }

  // Where no sampler with cameras answers, the panel is not there.
  async next() {
    try {
      const answer = await fetch("api/picture");
      if (answer.status !== 200) throw new Error("no picture");
      this.image.src = await dataUrl(await answer.blob());
      this.section.hidden = false;
      text("picture-text", `As of ${new Date().toLocaleTimeString("en-GB")}.`);
      return true;
    } catch {
      this.section.hidden = true;
      return false;
    }
  }
}
