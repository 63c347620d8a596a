// The planes of packing.py as arrays for textures.

const BLOCK = 256, ROW = 4096; // splats per block; texels per row of a texture, which phones support

// Decode the text of a script element piece by piece, so that a large page needs no second copy of it.
function* decodePieces(text) {
  const step = 1 << 20;
  for (let begin = 0; begin < text.length; begin += step) {
    const letters = atob(text.slice(begin, begin + step)), bytes = new Uint8Array(letters.length);
    for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
    yield bytes;
  }
}

async function inflate(text) {
  if (!self.DecompressionStream) throw Error("this browser is too old: it has no DecompressionStream; update it");
  const stream = new DecompressionStream("gzip"), writer = stream.writable.getWriter();
  const writing = (async () => {
    for (const bytes of decodePieces(text)) await writer.write(bytes);
    await writer.close();
  })();
  return (await Promise.all([new Response(stream.readable).arrayBuffer(), writing]))[0];
}

// texels of 16 bytes for the colors of a splat: 3 (degree + 1)² codes
const colorTexels = degree => Math.ceil(3 * (degree + 1) ** 2 / 16);
const splatsInRow = texels => Math.floor(ROW / texels);
const rowsOf = (count, texels) => Math.max(1, Math.ceil(count / splatsInRow(texels)));

// An array for a texture with complete rows.
const paddedArray = (kind, count, texels, each) =>
  new kind(rowsOf(count, texels) * splatsInRow(texels) * texels * each);

// header, buffer: from packing.py; maxRows: largest number of rows of a texture; the least important splats that exceed
// it are dropped.
function unpackModel(header, buffer, maxRows) {
  const whole = header.count, texels = colorTexels(header.degree);
  const count = Math.min(whole, maxRows * splatsInRow(texels), maxRows * ROW);
  let place = 0;
  const take = (kind, length) => {
    const part = new kind(buffer, place, length);
    place += part.byteLength;
    return part;
  };
  const tables = take(Float32Array, 4 * 256), blocks = take(Float32Array, 6 * Math.ceil(whole / BLOCK));
  const steps = take(Uint8Array, 6 * whole);
  const quats = new Uint32Array(buffer.slice(place, place + 4 * whole)); // a copy, since the offset is not aligned to 4
  place += 4 * whole;
  const shapes = take(Uint8Array, 4 * whole), codes = take(Uint8Array, 3 * (header.degree + 1) ** 2 * whole);

  const positions = new Float32Array(3 * count), places = paddedArray(Uint32Array, count, 1, 4);
  const floats = new Float32Array(places.buffer);
  for (let i = 0; i < count; i++) {
    const block = 6 * Math.floor(i / BLOCK);
    for (let axis = 0; axis < 3; axis++) {
      const step = steps[axis * whole + i] + 256 * steps[(axis + 3) * whole + i];
      const t = blocks[block + axis] + blocks[block + 3 + axis] * step;
      const value = header.origin[axis] + header.unit * Math.sign(t) * Math.expm1(Math.abs(t));
      positions[3 * i + axis] = floats[4 * i + axis] = value;
    }
    places[4 * i + 3] = quats[i];
  }
  const sizes = interleave(shapes, whole, count, 4, paddedArray(Uint8Array, count, 1, 4), 4);
  const each = 16 * texels, motion = header.motion && unpackMotion(header.motion.columns, buffer, place, whole, count);
  const padded = paddedArray(Uint8Array, count, texels, 16);
  const colors = interleave(codes, whole, count, codes.length / whole, padded, each);
  return {count, whole, texels, tables, positions, motion, places, sizes: new Uint32Array(sizes.buffer),
    colors: new Uint32Array(colors.buffer)};
}

// Planes [columns, whole] of half floats as rows of texels: {rows, wide: texels of a row}.
function unpackMotion(columns, buffer, place, whole, count) {
  const bytes = new Uint8Array(buffer, place, 2 * columns * whole), wide = Math.ceil(columns / 4);
  const rows = paddedArray(Float32Array, count, wide, 4);
  for (let column = 0; column < columns; column++) {
    for (let i = 0; i < count; i++) {
      const from = 2 * (column * whole + i), half = bytes[from] + 256 * bytes[from + 1];
      rows[4 * wide * i + column] = halfFloat(half);
    }
  }
  return {rows, wide};
}

const halfFloat = half => {
  const sign = half >> 15 ? -1 : 1, exponent = (half >> 10) & 31, rest = half & 1023;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + rest / 1024) : rest * 2 ** -24);
};

// Interleave byte planes [number, whole] into `each` bytes per splat.
function interleave(planes, whole, count, number, out, each) {
  for (let plane = 0; plane < number; plane++) {
    for (let i = 0, from = plane * whole, to = plane; i < count; i++, from++, to += each) out[to] = planes[from];
  }
  return out;
}
