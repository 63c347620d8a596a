// The timestamp that the page of a moving scene shows: a slider, play and pause.

const LOOP_SECONDS = 4; // time to play the whole scene once

class Clock {
  // timestamps: of the photos, in order, in [0, 1]
  constructor(viewer, timestamps) {
    Object.assign(this, {viewer, timestamps, playing: false});
    this.range = find("timestamp");
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

  // Go to a timestamp, and leave a photo that was taken at another time.
  to(timestamp) {
    const {viewer} = this, shown = viewer.photographs.views[viewer.photographs.chosen];
    viewer.timestamp = Math.max(0, Math.min(1, timestamp));
    if (shown && Math.abs((shown.time ?? viewer.timestamp) - viewer.timestamp) > 1e-6) {
      viewer.move(viewer.camera);
      viewer.panel.showMessage(`${shown.name} was taken at another time`);
    }
    this.show();
    viewer.change();
  }

  // Go to the next or the previous timestamp of the photos, if there is one.
  skip(by) {
    this.stop();
    const beyond = this.timestamps.filter(timestamp => by * (timestamp - this.viewer.timestamp) > 1e-6);
    if (beyond.length) this.to(by > 0 ? beyond[0] : beyond[beyond.length - 1]);
  }

  // Advance by seconds while playing, in a loop.
  run(seconds) {
    if (this.playing) this.to((this.viewer.timestamp + Math.min(0.5, seconds) / LOOP_SECONDS) % 1);
  }

  show() {
    const {timestamp} = this.viewer, name = this.playing ? "pause" : "play";
    this.range.value = timestamp;
    find("now").textContent = timestamp.toFixed(2);
    find("play").title = `${name} (space)`;
    find("play").setAttribute("aria-label", name);
    find("play").setAttribute("aria-pressed", this.playing);
  }
}
