// Keys and clicks on the canvas.

const TURNS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const ZOOMS = { "+": 1, "=": 1, "-": -1, _: -1 };
const STILL_PX = 4;

/** Turn and zoom by keys; `chosen(number)` is called for a digit. */
export function onKeys(stage, chosen) {
  stage.canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key in TURNS) stage.turn(...TURNS[event.key]);
    else if (event.key in ZOOMS) stage.turn(0, 0, ZOOMS[event.key]);
    else if (/^[0-9]$/.test(event.key)) chosen(Number(event.key));
    else return;
    event.preventDefault();
  });
}

/** Call `clicked(event)` for a click that did not turn the face. */
export function onClick(stage, clicked) {
  let from = null;
  stage.canvas.addEventListener("pointerdown", (event) => { from = event; });
  stage.canvas.addEventListener("pointerup", (event) => {
    const way = from ? Math.hypot(event.clientX - from.clientX, event.clientY - from.clientY) : Infinity;
    if (event.button === 0 && way < STILL_PX) clicked(event);
  });
}
