// Files that a job left: to look at, to open, to keep.

import { bytes, post, request } from "../api.js";
import { h } from "../dom.js";
import { save } from "../rig/hand_out.js";
import { bytes as size } from "../words.js";
import { table } from "./frame.js";
import { doing } from "./toast.js";

const PAGE = "text/html";

/** Return a table of artifacts with a button to keep each. */
export function fileTable(artifacts) {
  return table(
    ["File", "Size", "(Actions)"],
    h(
      "tbody",
      {},
      artifacts.map((artifact) =>
        h(
          "tr",
          {},
          h("th", { scope: "row" }, artifact.name),
          h("td", {}, size(artifact.size)),
          h(
            "td",
            { class: "tight" },
            h(
              "div",
              { class: "row end" },
              artifact.media_type === PAGE && act("Open", artifact, openPage),
              act("Download", artifact, download),
            ),
          ),
        ),
      ),
    ),
  );
}

function act(words, artifact, action) {
  const button = h(
    "button",
    { type: "button", onclick: () => doing(button, () => action(artifact)) },
    words,
    h("span", { class: "unseen" }, ` ${artifact.name}`),
  );
  return button;
}

/** Save a file; it is fetched with the key, which a plain link could not carry. */
async function download({ id, name, media_type: type }) {
  save(new Blob([await bytes(`/v1/artifacts/${id}`)], { type }), name);
}

// What other programs read of a rig, by its files' names; USD is there where its extra is.
const FORMATS = { GLB: "rig.glb", USD: "rig.usdc" };

/** Return buttons that save a rig: for other programs, and whole with its model. */
export function rigDownloads({ id, artifacts }) {
  const files = Object.entries(FORMATS).map(([words, name]) => [words, artifacts.find((each) => each.name === name)]);
  const whole = { name: `rig-${id.slice(0, 8)}.zip` };
  return [
    ...files.map(([words, file]) => file && act(words, file, download)),
    act("ZIP", whole, async ({ name }) => save(new Blob([await bytes(`/v1/rigs/${id}/archive`)]), name)),
  ];
}

/** Open a stored page in a window of its own, where it keeps its own strict rules. */
export async function openPage({ id }) {
  const { url } = await post(`/v1/artifacts/${id}/url`); // a window cannot send the key
  open(url, "_blank", "noopener");
}

/** Return an image of an artifact; its place is taken by a sentence if it cannot be shown. */
export function picture(artifact, alt, signal) {
  const image = h("img", { alt, class: "picture" });
  image.onload = () => URL.revokeObjectURL(image.src);
  return shown(artifact, image, signal);
}

/** Return a player of a film; its place is taken by a sentence if it cannot be shown. */
export function film(artifact, signal) {
  const player = h("video", { controls: true, loop: true, class: "picture", "aria-label": artifact.name });
  signal.addEventListener("abort", () => URL.revokeObjectURL(player.src));
  return shown(artifact, player, signal);
}

function shown(artifact, element, signal) {
  const place = h("div", { class: "picture-place" }, element);
  const fail = () => place.replaceChildren(h("p", { class: "fine" }, `${artifact.name} cannot be shown.`));
  element.onerror = fail;
  request(`/v1/artifacts/${artifact.id}`, { signal })
    .then((response) => response.blob())
    .then((blob) => {
      element.src = URL.createObjectURL(new Blob([blob], { type: artifact.media_type }));
    })
    .catch(() => signal.aborted || fail());
  return place;
}
