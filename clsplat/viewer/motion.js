// The camera of a page: moved by the controls, flown to a view, stored in the URL.

class PageCamera {
  constructor(info, canvas) {
    Object.assign(this, {info, canvas, stage: canvas.parentElement, up: info.up, radius: info.radius, at: -1});
    this.camera = cameraOf(info.start);
    this.pivot = info.pivot;
  }

  // Read the camera and the timestamp from the URL; return whether it has a camera.
  readAddress() {
    const camera = location.hash === this.hash ? null : parseCamera(location.hash);
    if (camera) this.move(camera);
    if (camera && this.clock && camera.timestamp !== undefined) {
      this.clock.stop();
      this.clock.to(camera.timestamp);
    }
    return !!camera;
  }

  // Move to a camera that belongs to no photo.
  move(camera) {
    this.flight = null;
    this.at = -1;
    this.photographs.leave();
    this.camera = camera;
    this.change();
  }

  // Fly to a camera; view: the index of its view, or -1.
  fly(camera, seconds, view = -1) {
    this.at = -1;
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) seconds = 0;
    this.flight = {from: this.camera, to: camera, begin: performance.now(), seconds, view};
    this.change();
  }

  reset() {
    this.pivot = this.info.pivot;
    if (this.info.first >= 0) this.photographs.choose(this.info.first);
    else this.fly(cameraOf(this.info.start), 0.7);
  }

  widen(degrees) {
    const [fx, fy, , , width, height] = this.camera.lens;
    const focal = Math.min(width, height) / 2 / Math.tan(degrees * Math.PI / 360);
    this.move({...this.camera, lens: [focal, focal * fy / fx, ...this.camera.lens.slice(2)]});
  }

  // The size of the image, CSS px.
  pane() {
    return {width: this.stage.clientWidth, height: this.stage.clientHeight};
  }

  get focal() { // CSS px
    const {width, height} = this.pane();
    return this.camera.lens[0] * fitToCanvas(this.camera.lens, width, height).enlarged;
  }

  advance(time) {
    const {from, to, begin, seconds, view} = this.flight, t = seconds ? (time - begin) / 1000 / seconds : 1;
    if (t >= 1) {
      [this.camera, this.at, this.flight] = [to, view, null];
      this.changed = performance.now();
      if (view >= 0) this.photographs.arrived();
    } else this.camera = interpolateCameras(from, to, Math.max(0, t * t * (3 - 2 * t)));
  }

  // The camera is at rest: store it in the URL.
  storeInAddress() {
    const text = `#${formatCamera(this.camera)}${this.clock ? `;${+this.timestamp.toFixed(4)}` : ""}`;
    if (text === location.hash) return;
    this.hash = text;
    try { history.replaceState(null, "", text); } catch { /* too frequent, or not allowed: keep the URL */ }
  }
}
