// The requests of the page to the run: its state at intervals, and images one at a time.

const STATE = 1000, HIDDEN = 10000, AGAIN = 1000, PATIENCE = 250, PUMP = 60; // ms
const PAGE = Math.floor(Math.random() * 1e9); // identifies the page in the queue of the run

class Link {
  constructor(live) {
    Object.assign(this, {live, number: 0, shown: 0, waiting: null, failures: 0});
    this.poll();
    setInterval(() => this.pump(), PUMP);
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
      if (++this.failures > 2) this.live.lost();
    }
    this.timer = setTimeout(() => this.poll(), document.hidden ? HIDDEN : STATE);
  }

  async press(paused) {
    await fetch(paused ? "pause" : "resume").catch(() => {});
    this.poll();
  }

  // Request an image if the visible one is of another camera or another step.
  pump() {
    const {live, waiting} = this, now = performance.now(), wish = live.wish();
    if (!wish || document.hidden || now < (this.rest ?? 0)) return;
    const {key, pace} = wish;
    if (waiting && (waiting.key === key && waiting.pace === pace || now - waiting.begin < PATIENCE)) return;
    if (pace === "again" && now - this.arrived < AGAIN) return;
    this.ask({key, pace, camera: wish.camera, number: ++this.number, begin: now});
  }

  async ask(order) {
    this.waiting = order;
    try {
      const answer = await fetch(`frame.jpg?page=${PAGE}&pace=${order.pace}&${order.key}`);
      if (answer.status === 200) {
        const bitmap = await createImageBitmap(await answer.blob());
        if (order.number > this.shown) { // a newer image may have arrived while this one was decoded
          [this.shown, this.arrived] = [order.number, performance.now()];
          this.live.show({...order, bitmap, step: +answer.headers.get("X-Step")});
        } else bitmap.close();
      } else if (!answer.ok) this.rest = performance.now() + AGAIN;
    } catch { this.rest = performance.now() + AGAIN; }
    if (this.waiting === order) this.waiting = null;
    this.pump();
  }
}
