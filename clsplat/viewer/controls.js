// Pointer, wheel, touch and keyboard.  They change `viewer.camera` with `viewer.move`, which leaves a photo's view.

const TURN = 0.005, MIN_TILT = 0.06; // radians per px; smallest angle between the view direction and up
const KEYS = {w: [2, 1], s: [2, -1], a: [0, -1], d: [0, 1], q: [1, 1], e: [1, -1]}; // axis and sign

class Controls {
  constructor(viewer, canvas) {
    Object.assign(this, {viewer, canvas, style: "orbit"});
    this.pointers = new Map();
    this.pressed = new Set();
    canvas.addEventListener("pointerdown", event => this.down(event));
    canvas.addEventListener("pointermove", event => this.moved(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, event => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", event => {
      event.preventDefault();
      this.dolly(Math.exp(Math.max(-60, Math.min(60, event.deltaY * (event.deltaMode ? 16 : 1))) / 500));
    }, {passive: false});
    canvas.addEventListener("dblclick", event => viewer.focus(event.offsetX, event.offsetY));
    canvas.addEventListener("contextmenu", event => event.preventDefault());
    addEventListener("keydown", event => this.key(event));
    addEventListener("keyup", event => this.pressed.delete(event.key.toLowerCase()));
    addEventListener("blur", () => { this.pressed.clear(); this.pointers.clear(); });
  }

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.canvas.focus({preventScroll: true});
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    this.pans = event.button !== 0 || event.shiftKey;
  }

  moved(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], shift = add(now, before, -1);
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    this.pointers.set(event.pointerId, now);
    if (other) { // two fingers: each event moves their center by half of its shift, and changes their distance
      this.pan(scaled(shift, 0.5));
      this.dolly(size(add(before, other, -1)) / Math.max(1, size(add(now, other, -1))));
    } else if (this.pans) this.pan(shift);
    else if (this.style === "fly") this.look(shift);
    else this.orbit(shift);
  }

  // Tilt about the right axis, but not beyond the zenith.
  tilt(camera, angle, center) {
    const after = rotated(camera, axis(camera, 0), angle, center);
    const cosine = Math.abs(dot(axis(after, 2), this.viewer.up));
    return cosine > Math.cos(MIN_TILT) && cosine > Math.abs(dot(axis(camera, 2), this.viewer.up)) ? camera : after;
  }

  orbit([x, y]) {
    const {camera, up, pivot} = this.viewer;
    this.viewer.move(this.tilt(rotated(camera, up, -x * TURN, pivot), -y * TURN, pivot));
  }

  look([x, y]) {
    const {camera, up} = this.viewer;
    this.viewer.move(this.tilt(rotated(camera, up, x * TURN / 2, camera.eye), y * TURN / 2, camera.eye));
    this.viewer.pivot = this.ahead(this.viewer.camera);
  }

  // The point ahead at the distance of the pivot.
  ahead(camera) {
    const {pivot, radius} = this.viewer;
    return add(camera.eye, axis(camera, 2), Math.max(0.05 * radius, size(add(pivot, camera.eye, -1))));
  }

  pan([x, y]) {
    const {camera, pivot} = this.viewer, depth = size(add(pivot, camera.eye, -1)), pixel = depth / this.viewer.focal;
    this.shift(add(scaled(axis(camera, 0), -x * pixel), axis(camera, 1), -y * pixel));
  }

  shift(by) {
    this.viewer.pivot = add(this.viewer.pivot, by);
    this.viewer.move({...this.viewer.camera, eye: add(this.viewer.camera.eye, by)});
  }

  dolly(factor) {
    const {camera, pivot, radius} = this.viewer, away = add(camera.eye, pivot, -1);
    if (this.style === "fly") return this.shift(scaled(axis(camera, 2), -Math.log(factor) * radius / 2));
    if (size(away) * factor < 0.01 * radius || size(away) * factor > 50 * radius) return;
    this.viewer.move({...camera, eye: add(pivot, away, factor)});
  }

  // Fly with the pressed keys; seconds: since the last call.  Return whether any key is pressed.
  fly(seconds) {
    let by = [0, 0, 0];
    for (const key of this.pressed) if (KEYS[key]) by = add(by, axis(this.viewer.camera, KEYS[key][0]), KEYS[key][1]);
    if (size(by) < 1e-6) return false;
    const speed = this.viewer.radius * (this.pressed.has("shift") ? 2 : 0.5); // per second
    this.shift(scaled(normalized(by), Math.min(0.1, seconds) * speed));
    return true;
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.toLowerCase(), viewer = this.viewer;
    if (key in KEYS || key === "shift") {
      this.pressed.add(key);
      if (key in KEYS) viewer.change();
      return;
    }
    const action = {
      arrowleft: () => viewer.photographs.step(-1), arrowright: () => viewer.photographs.step(1),
      p: () => viewer.photographs.cycle(), r: () => viewer.reset(),
      l: () => viewer.move(withoutRoll(viewer.camera, viewer.up)),
      o: () => viewer.panel.style(this.style === "orbit" ? "fly" : "orbit"), h: () => viewer.panel.hide(),
      g: () => viewer.panel.cameras(!viewer.frustums.shown),
      f: () => viewer.panel.fullscreen(), c: () => viewer.screenshot(), "?": () => viewer.panel.help(),
      1: () => viewer.panel.mode?.("splats"), 2: () => viewer.panel.mode?.("points"),
      3: () => viewer.panel.mode?.("ellipsoids"), 4: () => viewer.panel.mode?.("opacity"),
      " ": viewer.clock ? () => viewer.clock.turn() : viewer.pause && (() => viewer.pause()),
      ",": viewer.clock && (() => viewer.clock.skip(-1)), ".": viewer.clock && (() => viewer.clock.skip(1)),
    }[key];
    if (!action || (event.target.matches("input") && key.startsWith("arrow"))) return;
    if (key === " " && event.target.closest("button")) return;
    event.preventDefault();
    action();
  }
}
