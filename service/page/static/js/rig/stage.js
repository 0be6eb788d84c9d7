// The canvas: one camera over one or two panes, drawn when something has changed and not otherwise.

import {
  Color, DirectionalLight, HemisphereLight, OrbitControls, PerspectiveCamera, Raycaster, Scene,
  Vector2, Vector3, WebGLRenderer,
} from "../../vendor/three.js";

const FIELD_OF_VIEW = 26; // degrees, up and down: a portrait lens
const MOST_PIXELS = 2; // of the canvas by those of the page
const TURN = Math.PI / 36;
const ZOOM = 1.12;

/** Camera places by name: azimuth towards the subject's left and elevation, in degrees. */
export const VIEWS = {
  front: [0, 0],
  "three-quarter": [-35, 5],
  side: [-90, 0],
  "other-side": [90, 0],
};

/** From where a cut across an axis is seen. */
export const CUT_VIEWS = { x: "side", y: [0, 60, 1, 0, 0, 0], z: "front" };

/** Draws scenes into a canvas; `panes` are scenes side by side that the same camera looks at. */
export class Stage extends EventTarget {
  #renderer;
  #wanted = 0;
  #resizes;
  #size = { width: 1, height: 1 };
  #background = "#ffffff";
  #centre = new Vector3();
  #distance = 500;
  #shown = 1;
  #wide = 1;

  constructor(canvas) {
    super();
    this.canvas = canvas;
    this.#renderer = new WebGLRenderer({ canvas, antialias: true });
    this.#renderer.setPixelRatio(isSoftware(this.#renderer) ? 1 : Math.min(devicePixelRatio, MOST_PIXELS));
    this.#renderer.localClippingEnabled = true;
    this.#renderer.setScissorTest(true);
    this.camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 10, 4000);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => {
      this.invalidate();
      this.dispatchEvent(new Event("look"));
    });
    this.panes = [litScene()];
    this.#resizes = new ResizeObserver(() => this.#resize());
    this.#resizes.observe(canvas.parentElement);
    this.#resize();
  }

  /** Show this many panes, each a scene of its own. */
  setPanes(count) {
    while (this.panes.length < count) this.panes.push(litScene());
    this.#shown = count;
    this.setBackground(this.#background);
  }

  /** Set the colour behind everything. */
  setBackground(colour) {
    this.#background = colour;
    for (const scene of this.panes) scene.background = new Color(colour);
    this.invalidate();
  }

  /** Look at a face in this box, mm; `low` and `high` are corners. */
  frame(low, high) {
    this.#centre.set((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2);
    const half = Math.max(high[1] - low[1], 0.6 * (high[0] - low[0])) / 2;
    this.#wide = Math.max(high[0] - low[0], 0.8 * (high[2] - low[2])) / (2 * half);
    this.#distance = (1.04 * half) / Math.tan((FIELD_OF_VIEW * Math.PI) / 360) + (high[2] - low[2]) / 2;
    this.controls.minDistance = this.#distance / 12;
    this.controls.maxDistance = this.#distance * 4;
  }

  /** Look from a place by its name, or as `view` gave it: azimuth, elevation, nearness, centre. */
  look(view) {
    const [azimuth, elevation, zoom = 1, x = 0, y = 0, z = 0] = VIEWS[view] ?? view;
    this.controls.target.set(x, y, z).add(this.#centre);
    const a = (azimuth * Math.PI) / 180;
    const e = (elevation * Math.PI) / 180;
    const way = new Vector3(Math.sin(a) * Math.cos(e), Math.sin(e), Math.cos(a) * Math.cos(e));
    this.camera.position.copy(this.controls.target).addScaledVector(way, this.#distance / zoom);
    this.controls.update();
    this.invalidate();
  }

  /** Return where the camera is, as `look` takes it; its name if it has one. */
  get view() {
    const offset = this.camera.position.clone().sub(this.controls.target);
    const target = this.controls.target.clone().sub(this.#centre);
    const radius = offset.length();
    const numbers = [
      (Math.atan2(offset.x, offset.z) * 180) / Math.PI,
      (Math.asin(offset.y / radius) * 180) / Math.PI,
      this.#distance / radius,
      ...target.toArray(),
    ].map((value, i) => Number(value.toFixed(i === 2 ? 3 : 1)) + 0);
    const still = numbers[2] === 1 && !numbers[3] && !numbers[4] && !numbers[5];
    const named = Object.entries(VIEWS).find(([, at]) => still && at[0] === numbers[0] && at[1] === numbers[1]);
    return named ? named[0] : numbers;
  }

  /** Turn by steps about the face, or go nearer by steps. */
  turn(right, up, nearer = 0) {
    const offset = this.camera.position.clone().sub(this.controls.target);
    const radius = offset.length() / ZOOM ** nearer;
    const azimuth = Math.atan2(offset.x, offset.z) + right * TURN;
    const elevation = Math.asin(offset.y / offset.length()) + up * TURN;
    const e = Math.max(-1.5, Math.min(1.5, elevation));
    const way = new Vector3(Math.sin(azimuth) * Math.cos(e), Math.sin(e), Math.cos(azimuth) * Math.cos(e));
    this.camera.position.copy(this.controls.target).addScaledVector(way, radius);
    this.controls.update();
  }

  /** Ask for a drawing before the next frame of the screen. */
  invalidate() {
    this.#wanted ||= requestAnimationFrame(() => this.draw());
  }

  /** Draw now. */
  draw() {
    cancelAnimationFrame(this.#wanted);
    this.#wanted = 0;
    this.dispatchEvent(new Event("draw"));
    const { width, height } = this.#size;
    const wide = width / this.#shown;
    this.camera.aspect = wide / height;
    this.camera.zoom = Math.min(1, this.camera.aspect / this.#wide); // all of the face in a tall pane
    this.camera.updateProjectionMatrix();
    for (let i = 0; i < this.#shown; i++) {
      this.#renderer.setViewport(i * wide, 0, wide, height);
      this.#renderer.setScissor(i * wide, 0, wide, height);
      this.#renderer.render(this.panes[i], this.camera);
    }
    this.dispatchEvent(new Event("drawn"));
  }

  /** Size of the canvas in pixels of the page. */
  get size() {
    return this.#size;
  }

  /** Return where the first pane shows a point (x, y, z in mm): x and y in pixels of the page. */
  project(point) {
    const { x, y } = new Vector3(...point).project(this.camera);
    return [((x + 1) * this.#size.width) / 2 / this.#shown, ((1 - y) * this.#size.height) / 2];
  }

  /** Draw now and wait until it is in the canvas. */
  finish() {
    this.draw();
    const gl = this.#renderer.getContext();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  /** Return where the line of sight through the pointer meets `objects`, the nearest first. */
  pick(event, objects) {
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    const wide = width / this.#shown;
    const x = (event.clientX - left) % wide;
    const caster = new Raycaster();
    caster.setFromCamera(new Vector2((2 * x) / wide - 1, 1 - (2 * (event.clientY - top)) / height), this.camera);
    return caster.intersectObjects(objects, false);
  }

  /** Return the drawing as a PNG. */
  picture() {
    this.draw();
    return new Promise((resolve) => { this.canvas.toBlob(resolve, "image/png"); });
  }

  /** Stop and give the graphics memory back. */
  dispose() {
    cancelAnimationFrame(this.#wanted);
    this.#resizes.disconnect();
    this.controls.dispose();
    for (const scene of this.panes) {
      scene.traverse((object) => {
        object.geometry?.dispose();
        object.material?.dispose();
      });
    }
    this.#renderer.dispose();
    this.#renderer.forceContextLoss();
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.#size = { width, height };
    this.#renderer.setSize(width, height);
    this.draw();
  }
}

function litScene() {
  const scene = new Scene();
  const key = new DirectionalLight("#fff1e2", 2.6);
  key.position.set(-0.6, 0.75, 0.8);
  const fill = new DirectionalLight("#cfe0ff", 0.8);
  fill.position.set(0.9, 0.05, 0.6);
  const rim = new DirectionalLight("#ffffff", 1.4);
  rim.position.set(0.7, 0.5, -0.9);
  scene.add(new HemisphereLight("#e8eef6", "#6d4a3c", 0.95), key, fill, rim);
  return scene;
}

/** Whether the drawing is done by the processor: then fewer pixels. */
function isSoftware(renderer) {
  const gl = renderer.getContext();
  const names = gl.getExtension("WEBGL_debug_renderer_info");
  return /swiftshader|llvmpipe|software/i.test(names ? gl.getParameter(names.UNMASKED_RENDERER_WEBGL) : "");
}
