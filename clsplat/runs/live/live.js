// The page: the newest image, moved along with the camera until the next one arrives.

const MOVING_MS = 250; // ms since the last change of the camera

class Live extends PageCamera {
  constructor(info, curves) {
    super(info, find("canvas"));
    Object.assign(this, {curves, state: {}, newest: null});
    this.panel = new Panel(this);
    this.photographs = new Photographs(this, info.views);
    this.frustums = new Frustums(this, info.views);
    this.controls = new Controls(this, this.canvas);
    this.photographs.compare("off");
    new ResizeObserver(() => { this.photographs.place(); this.change(); }).observe(this.stage);
    addEventListener("hashchange", () => this.readAddress());
    find("strip").addEventListener("error", ({target}) => { // the thumbnail was not read in time
      if (target.src && !target.src.endsWith("&")) setTimeout(() => { target.src += "&"; }, 5000);
    }, true);
    if (!this.readAddress() && info.first >= 0) this.photographs.choose(info.first, 0);
    this.change();
  }

  change() {
    this.changed = performance.now();
    delete document.documentElement.dataset.ready;
    this.schedule();
  }

  schedule() { this.scheduled ??= requestAnimationFrame(time => this.tick(time)); }

  tick(time) {
    this.scheduled = undefined;
    const passed = time - (this.time ?? time);
    this.time = time;
    if (this.flight) this.advance(time);
    if (this.controls.fly(passed / 1000) || this.flight) this.change();
    else this.time = undefined;
    this.draw();
  }

  // The camera of the next image: that of a view, or that of the stage.  pace: as in preview.py.
  nextRequest() {
    if (!this.state.drawn || this.state.ended) return null;
    const {width, height} = this.pane(), exact = this.at >= 0;
    if (width < 8 || height < 8) return null;
    const {intrinsics} = makeFrame(this.camera, width, height, false), lens = [...intrinsics, width, height];
    const camera = exact ? this.camera : {...this.camera, lens};
    if (exact) this.timestamp = this.info.views[this.at].time;
    const then = this.timestamp === undefined ? "" : `&time=${this.timestamp}`; // of the last chosen photograph
    const key = exact ? `view=${this.at}` : `camera=${formatCamera(camera)}${then}`, same = this.newest?.key === key;
    const moving = performance.now() - this.changed < MOVING_MS || this.controls.pointers.size > 0 && !same;
    if (moving) return same ? null : {key, camera, pace: "moving"};
    if (!same || this.newest.pace === "moving") return {key, camera, pace: "still"};
    return this.newest.step !== this.state.drawn ? {key, camera, pace: "again"} : null;
  }

  show(picture) {
    this.newest?.bitmap.close();
    this.newest = picture;
    find("message").hidden = true;
    this.schedule();
  }

  draw() {
    const context = this.canvas.getContext("2d");
    const ratio = Math.min(2, devicePixelRatio || 1), {width, height} = this.pane();
    const [wide, high] = [width, height].map(side => Math.max(1, Math.round(side * ratio)));
    if (this.canvas.width !== wide) this.canvas.width = wide;
    if (this.canvas.height !== high) this.canvas.height = high;
    const frame = makeFrame(this.camera, width, height, false);
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillRect(0, 0, wide, high);
    if (this.newest) this.paint(context, frame, ratio);
    this.frustums.draw(frame, [[0, 0]], ratio);
    if (this.newest) this.describe();
  }

  // Move the image to where its plane at the distance of the pivot is visible from the current camera.
  paint(context, frame, ratio) {
    const {bitmap, camera} = this.newest, [fx, fy, cx, cy, width, height] = camera.lens;
    const depth = Math.max(0.05 * this.radius, dot(axis(camera, 2), add(this.pivot, camera.eye, -1)));
    const corners = [[0, 0], [width, 0], [0, height]].map(([x, y]) => {
      const across = add(scaled(axis(camera, 0), (x - cx) / fx), axis(camera, 1), (y - cy) / fy);
      return projectPoint(frame, add(camera.eye, add(across, axis(camera, 2)), depth));
    });
    if (!corners.every(Boolean)) return;
    const [origin, right, below] = corners, {width: columns, height: rows} = bitmap;
    const [u, v] = [scaled(add(right, origin, -1), 1 / columns), scaled(add(below, origin, -1), 1 / rows)];
    context.setTransform(...scaled([...u, ...v, ...origin], ratio));
    context.imageSmoothingQuality = "high";
    context.drawImage(bitmap, 0, 0);
  }

  describe() {
    const {bitmap, step, pace} = this.newest, still = pace !== "moving" && !this.nextRequest();
    find("statistics").textContent = `step ${formatCount(step)} · ${bitmap.width} × ${bitmap.height} px`;
    if (!still && this.nextRequest()?.pace !== "again") return;
    this.storeInAddress();
    document.documentElement.dataset.ready = "1";
  }

  pause() { if (!find("pause").disabled) link.setPaused(!this.state.paused); }

  focus() {} // an image has no depths

  screenshot() {
    this.canvas.toBlob(blob => {
      const anchor = document.createElement("a");
      anchor.href = URL.createObjectURL(blob);
      anchor.download = `step_${this.newest?.step ?? 0}.png`;
      anchor.click();
      setTimeout(() => URL.revokeObjectURL(anchor.href), 1000);
    });
  }
}

// The state of the run, with its scene as soon as it has been read.
class Watch {
  constructor() {
    this.curves = new Curves();
    this.scene = 0;
    find("pause").addEventListener("click", () => this.live?.pause());
    find("help").addEventListener("click", () => { if (!this.live) find("keys").showModal(); });
    const port = location.port || 80;
    find("tunnel").textContent = `ssh -L ${port}:127.0.0.1:${port} HOST`;
  }

  nextRequest() { return this.live?.nextRequest(); }
  show(picture) { this.live.show(picture); }

  async take(state) {
    if (state.scene !== this.scene) await this.enter(state.scene);
    this.curves.add((state.points ?? []).filter(([step]) => step > this.curves.last));
    if (this.live) this.live.state = state;
    find("state").textContent = this.stateText(state);
    find("bar").value = state.steps ? Math.min(1, state.step / state.steps) : 0;
    find("pause").disabled = !state.drawn || state.ended;
    find("pause").hidden = state.ended;
    find("pause").textContent = state.paused ? "Resume" : "Pause";
    find("pause").classList.toggle("paused", state.paused);
    if (state.host) find("tunnel").textContent = find("tunnel").textContent.replace(/\S+$/, state.host);
    if (!this.live?.newest) find("message").textContent = state.ended ? this.endText(state) : this.stateText(state);
    this.showNotice(state.ended ? this.endText(state) : state.fault);
    this.live?.schedule();
  }

  async enter(number) {
    const answer = await fetch("scene.json"), info = await answer.json();
    if (info.number !== number) return;
    if (this.scene) return location.reload(); // the next run of a matrix
    this.scene = number;
    document.querySelector("h1").textContent = document.title = info.title;
    this.live = new Live(info, this.curves);
  }

  stateText({state, stage, progress, step, steps, seconds_left: left, paused, ended}) {
    if (!state) return ended ? "ended" : "Waiting for the run …";
    const end = {done: "finished", failed: "failed", interrupted: "interrupted"}[state] ?? (ended && "ended");
    const doing = paused ? "paused" : stage && stage !== "optimize" ? stage.replaceAll("_", " ") : state;
    const parts = [end || doing];
    if (!end && progress && progress.unit !== "steps") {
      parts.push(`${formatCount(progress.done)} of ${formatCount(progress.total)} ${progress.unit}`);
    }
    if (step && steps) parts.push(`step ${formatCount(step)} of ${formatCount(steps)}`);
    if (left && !paused && ["preparing", "running"].includes(state)) parts.push(`${formatDuration(left)} left`);
    return parts.join(" · ");
  }

  endText({state, message}) {
    const how = {done: "The run is done", failed: "The run has failed", interrupted: "The run was interrupted"}[state];
    const folder = "; its folder contains viewer.html and report.html";
    return `${how ?? "The run has ended"}${message ? `: ${message}` : folder}.`;
  }

  showLost() {
    find("pause").disabled = true;
    if (!this.live?.state.ended) this.showNotice("The run cannot be reached: it has ended, or the tunnel is closed.");
  }

  showNotice(text) {
    find("notice").hidden = !text;
    if (text) find("notice").textContent = text;
  }
}

function formatDuration(seconds) {
  const whole = Math.round(seconds), two = number => String(number).padStart(2, "0");
  const [hours, minutes] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60];
  return hours ? `${hours}:${two(minutes)}:${two(whole % 60)}` : `${minutes}:${two(whole % 60)}`;
}

const watch = new Watch();
const link = new Link(watch);
globalThis.live = {watch, link};
