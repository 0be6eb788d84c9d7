// The skin of a live session: neutral and the shapes whose amounts come with every frame.

import { Container } from "../container.js";
import { blend } from "../face.js";

/** What `live_view.bin` holds: the basis (r, n, 3) of the session's reduced skin, mm. */
export class LiveSkin {
  #basis;

  constructor(buffer) {
    const file = new Container(buffer);
    const [count, vertices] = file.shape("basis");
    const basis = file.array("basis");
    this.#basis = Array.from({ length: count }, (_, r) => basis.subarray(3 * vertices * r, 3 * vertices * (r + 1)));
  }

  /** Set `out` to the places of a frame over the neutral. */
  pose(out, neutral, frame) {
    blend(out, neutral, frame.array("amounts"), (r) => this.#basis[r]);
  }
}
