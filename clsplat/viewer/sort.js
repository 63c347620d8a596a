// Sort splats from back to front in a worker: two counting sorts of 16 bits order depths exactly, since the bits of
// positive floats are ordered as their values.  Splats in front of the near plane are dropped.

// The factor of the opacity of splat i at a time dt after its most opaque time; motion: {rows, stride, bends}.
function opacityFactor({rows, stride}, i, dt) {
  const late = dt * Math.exp(-rows[i * stride + 4]);
  return Math.exp(-late * late / 2);
}

// The displacement of splat i along an axis at that time.
function displacement({rows, stride, bends}, i, axis, dt) {
  const k = i * stride + axis, bend = bends > 0 ? rows[k + 5] + (bends > 1 ? rows[k + 8] * dt : 0) : 0;
  return dt * (rows[k] + dt * bend);
}

function sortInWorker() {
  let positions, motion, now, keys, ids, otherKeys, otherIds;
  const counts = new Uint32Array(65537);

  function pass(shift, count, fromKeys, fromIds, toKeys, toIds) {
    counts.fill(0);
    for (let i = 0; i < count; i++) counts[((fromKeys[i] >>> shift) & 65535) + 1]++;
    for (let i = 0; i < 65536; i++) counts[i + 1] += counts[i];
    for (let i = 0; i < count; i++) {
      const to = counts[(fromKeys[i] >>> shift) & 65535]++;
      toKeys[to] = fromKeys[i];
      toIds[to] = fromIds[i];
    }
  }

  // The positions at a timestamp; NaN for splats that are invisible then.
  function at(timestamp) {
    for (let i = 0; 3 * i < positions.length; i++) {
      const dt = timestamp - motion.rows[i * motion.stride + 3], isInvisible = opacityFactor(motion, i, dt) < 1 / 255;
      for (let axis = 0; axis < 3; axis++) {
        now[3 * i + axis] = isInvisible ? NaN : positions[3 * i + axis] + displacement(motion, i, axis, dt);
      }
    }
    return now;
  }

  function sortIds({row, near, first, timestamp}) {
    const places = motion ? at(timestamp) : positions;
    const [x, y, z, w] = row, depths = new Float32Array(keys.buffer);
    let count = 0;
    for (let i = 0; i < first; i++) {
      const depth = x * places[3 * i] + y * places[3 * i + 1] + z * places[3 * i + 2] + w;
      if (!(depth >= near)) continue;
      depths[count] = depth;
      ids[count++] = i;
    }
    for (let i = 0; i < count; i++) keys[i] = ~keys[i]; // farthest first
    pass(0, count, keys, ids, otherKeys, otherIds);
    pass(16, count, otherKeys, otherIds, keys, ids);
    return ids.slice(0, count);
  }

  onmessage = ({data}) => {
    if (data.positions) {
      ({positions, motion} = data);
      now = motion && new Float32Array(positions.length);
      [keys, ids, otherKeys, otherIds] = Array.from({length: 4}, () => new Uint32Array(positions.length / 3));
    } else {
      const order = sortIds(data);
      postMessage({order, first: data.first, number: data.number}, [order.buffer]);
    }
  };
}

// A worker that sorts for one pose at a time, and then for the latest requested one.
class Sorter {
  // motion: {rows, stride, bends} of a moving model
  constructor(positions, motion, near, done) {
    const code = `${opacityFactor}\n${displacement}\n(${sortInWorker})()`;
    const source = URL.createObjectURL(new Blob([code], {type: "text/javascript"}));
    this.worker = new Worker(source);
    URL.revokeObjectURL(source);
    this.worker.postMessage({positions, motion}, [positions.buffer]);
    this.near = near;
    this.number = 0; // of the last request
    this.busy = this.current = false; // current: the last order answers the last request
    this.worker.onmessage = ({data}) => {
      this.busy = false;
      this.current = data.number === this.number;
      done(data.order, data.first);
      if (!this.current) this.send();
    };
  }

  // row: the third row of world_to_camera; first: number of splats, most important first; timestamp: in [0, 1]
  ask(row, first, timestamp) {
    const key = [...row, first, timestamp].join();
    if (key === this.key) return;
    Object.assign(this, {key, row, first, timestamp});
    this.number++;
    this.current = false;
    if (!this.busy) this.send();
  }

  send() {
    this.busy = true;
    const {row, near, first, timestamp, number} = this;
    this.worker.postMessage({row, near, first, timestamp, number});
  }
}
