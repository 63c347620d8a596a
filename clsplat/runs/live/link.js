// The requests of the page to the run: its state at intervals, and images one at a time.

const STATE_MS = 1000, HIDDEN_MS = 10000, AGAIN_MS = 1000, PATIENCE_MS = 250, REQUEST_MS = 60; // ms
const PAGE = Math.floor(Math.random() * 1e9); // identifies the page in the queue of the run

class Link {
  constructor(live) {
    Object.assign(this, {live, number: 0, shown: 0, waiting: null, failures: 0});
    this.poll();
    setInterval(() => this.requestNext(), REQUEST_MS);
    document.addEventListener("visibilitychange", () => { if (!document.hidden) this.poll(); });
  }

  async poll() {
    clearTimeout(this.timer);
    try {
      const answer = await fetch(`state.json?after=${this.live.curves.last}`);
      if (!answer.ok) throw Error(await answer.text());
      this.failures = 0;
      await this.live.take(await answer.json());
    } catch (error) {
      if (++this.failures > 2) this.live.showLost();
    }
    this.timer = setTimeout(() => this.poll(), document.hidden ? HIDDEN_MS : STATE_MS);
  }

  async setPaused(paused) {
    await fetch(paused ? "pause" : "resume").catch(() => {});
    this.poll();
  }

  // Request an image if the visible one is of another camera or another step.
  requestNext() {
    const {live, waiting} = this, now = performance.now(), nextRequest = live.nextRequest();
    if (!nextRequest || document.hidden || now < (this.pausedUntil ?? 0)) return;
    const {key, pace} = nextRequest;
    if (waiting && (waiting.key === key && waiting.pace === pace || now - waiting.begin < PATIENCE_MS)) return;
    if (pace === "again" && now - this.arrived < AGAIN_MS) return;
    this.load({key, pace, camera: nextRequest.camera, number: ++this.number, begin: now});
  }

  async load(request) {
    this.waiting = request;
    try {
      const answer = await fetch(`frame.jpg?page=${PAGE}&pace=${request.pace}&${request.key}`);
      if (answer.status === 200) {
        const bitmap = await createImageBitmap(await answer.blob());
        if (request.number > this.shown) { // a newer image may have arrived while this one was decoded
          [this.shown, this.arrived] = [request.number, performance.now()];
          this.live.show({...request, bitmap, step: +answer.headers.get("X-Step")});
        } else bitmap.close();
      } else if (!answer.ok) this.pausedUntil = performance.now() + AGAIN_MS;
    } catch { this.pausedUntil = performance.now() + AGAIN_MS; }
    if (this.waiting === request) this.waiting = null;
    this.requestNext();
  }
}
