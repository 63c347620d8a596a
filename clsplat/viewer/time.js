// The moment that a page of a scene that moves shows: a slider, and play and pause.

const LOOP = 4; // s: the scene from its first moment to its last

class Clock {
  // moments: of the photographs, in order, of the whole
  constructor(viewer, moments) {
    Object.assign(this, {viewer, moments, playing: false});
    this.range = find("moment");
    this.range.addEventListener("input", () => { this.stop(); this.to(+this.range.value); });
    find("play").addEventListener("click", () => this.turn());
    this.show();
  }

  turn() {
    this.playing = !this.playing;
    this.show();
    this.viewer.change();
  }

  stop() {
    this.playing = false;
    this.show();
  }

  // Go to a moment: away from the photograph of another one.
  to(moment) {
    const {viewer} = this, shown = viewer.photographs.views[viewer.photographs.chosen];
    viewer.moment = Math.max(0, Math.min(1, moment));
    if (shown && Math.abs((shown.time ?? viewer.moment) - viewer.moment) > 1e-6) {
      viewer.move(viewer.camera);
      viewer.panel.tell(`${shown.name} is of another moment`);
    }
    this.show();
    viewer.change();
  }

  // The next moment of the photographs, or the last before this one, where there is one.
  skip(by) {
    this.stop();
    const beyond = this.moments.filter(moment => by * (moment - this.viewer.moment) > 1e-6);
    if (beyond.length) this.to(by > 0 ? beyond[0] : beyond[beyond.length - 1]);
  }

  // Go on by seconds while it plays; from the last moment to the first.
  run(seconds) {
    if (this.playing) this.to((this.viewer.moment + Math.min(0.5, seconds) / LOOP) % 1);
  }

  show() {
    const {moment} = this.viewer, name = this.playing ? "pause" : "play";
    this.range.value = moment;
    find("now").textContent = moment.toFixed(2);
    find("play").title = `${name} (space)`;
    find("play").setAttribute("aria-label", name);
    find("play").setAttribute("aria-pressed", this.playing);
  }
}
