// A live session from JavaScript, without any library: frames of weights go in, faces come out.
//
//     MYOFACE_API_KEY=... node docs/examples/live_client.js http://127.0.0.1:8765 RIG_ID
//
// Node 22 or later, Deno, Bun, or a page of the service's own site have `fetch` and `WebSocket`.
// Here the jaw opens and shuts for ten seconds; docs/reference/live.md says what else may be sent.

const [base, rig] = process.argv.slice(2);
const headers = { Authorization: `Bearer ${process.env.MYOFACE_API_KEY}`, "Content-Type": "application/json" };
const RATE = 60; // frames a second
const SECONDS = 10;

const opened = await fetch(`${base}/v1/live`, {
  method: "POST", headers, body: JSON.stringify({ rig_id: rig, source: "weights", options: { rate: RATE } }),
});
const session = await opened.json();
if (!opened.ok) throw new Error(session.detail);

const socket = new WebSocket(base.replace("http", "ws") + session.url);
socket.binaryType = "arraybuffer";
let ready = null;

socket.addEventListener("message", ({ data }) => {
  if (typeof data !== "string") {
    show(data);
    return;
  }
  const said = JSON.parse(data);
  if (said.type === "ready") {
    ready = said;
    play();
  } else if (said.type === "preparing") console.log(`${said.phase} ${Math.round(100 * said.fraction)} %`);
  else console.log(said);
});
socket.addEventListener("close", ({ code, reason }) => console.log(`closed: ${code} ${reason}`));

/** Send frames at their rate, and end the session. */
function play() {
  const rows = ready.expects.labels;
  const begun = performance.now();
  let number = 0;
  const timer = setInterval(() => {
    const seconds = (performance.now() - begun) / 1000;
    if (seconds > SECONDS) {
      clearInterval(timer);
      socket.send(JSON.stringify({ end: true }));
      return;
    }
    const weights = { jawOpen: 0.4 - 0.4 * Math.cos(4 * seconds) };
    socket.send(frame(++number, seconds, rows.map((name) => weights[name] ?? 0)));
  }, 1000 / RATE);
}

/** Return a frame in bytes: 20 of a header, then the numbers as float32, all little-endian. */
function frame(number, seconds, numbers) {
  const buffer = new ArrayBuffer(20 + 4 * numbers.length);
  const view = new DataView(buffer);
  [..."MYF>"].forEach((letter, i) => view.setUint8(i, letter.charCodeAt(0)));
  view.setUint16(4, 1, true); // the version
  view.setUint32(8, number, true);
  view.setFloat64(12, seconds, true);
  numbers.forEach((value, i) => view.setFloat32(20 + 4 * i, value, true));
  return buffer;
}

/** Show a followed frame: its number, the running error, and the muscles that contract most. */
function show(buffer) {
  const view = new DataView(buffer);
  const arrays = {};
  let offset = 36;
  for (const { name, shape } of ready.layout) {
    const size = shape.reduce((product, side) => product * side, 1);
    arrays[name] = new Float32Array(buffer, offset, size);
    offset += 4 * size;
  }
  const strongest = [...arrays.contractions.entries()].sort((a, b) => b[1] - a[1]).slice(0, 3);
  const pulls = strongest.map(([m, value]) => `${ready.muscles[m]} ${Math.round(100 * value)} %`);
  console.log(view.getUint32(8, true), millimetres(view.getFloat32(28, true)), pulls.join(", "));
}

function millimetres(value) {
  return Number.isNaN(value) ? "not measured yet" : `${value.toFixed(2)} mm`;
}
