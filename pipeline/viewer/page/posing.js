// An avatar in a pose, as pipeline/avatar/linear_avatar.py and pipeline/body/skinning.py compute it: bases,
// expression, linear blend skinning, covariances. No browser is needed: tests run this file under node.
"use strict";

const Posing = (() => {
  const TEXEL = 16; // floats a Gaussian: mean 3, covariance xx xy xz yy yz zz, colour 3, opacity, 3 unused

  // Bytes of pipeline/viewer/packed.py -> the avatar; rejects where they are damaged.
  async function unpack(bytes) {
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const buffer = await new Response(stream).arrayBuffer();
    const length = new DataView(buffer).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    if (header.format !== 1) throw new Error("made by another version of the project");
    const arrays = {};
    for (const [name, one] of Object.entries(header.arrays)) arrays[name] = values(buffer, 4 + length, one);
    return prepare(header, arrays);
  }

  function values(buffer, base, one) {
    const count = one.shape.reduce((product, side) => product * side, 1), at = base + one.at;
    if (one.kind === "f32") return new Float32Array(buffer, at, count);
    const raw = new Uint8Array(buffer, at, one.kind === "u16" ? 2 * count : count);
    if (!one.step) return raw;
    const found = new Float32Array(count), columns = one.step.length, wide = one.kind === "u16";
    for (let i = 0, column = 0; i < count; i++) {
      found[i] = one.low[column] + one.step[column] * (wide ? raw[i] + 256 * raw[count + i] : raw[i]);
      if (++column === columns) column = 0;
    }
    return found;
  }

  function transposed(given, rows, columns) { // [rows, columns] -> [columns, rows]
    const found = new Float32Array(given.length);
    for (let r = 0; r < rows; r++) for (let c = 0; c < columns; c++) found[c * rows + r] = given[r * columns + c];
    return found;
  }

  // What stays the same in every pose, laid out as the loops below read it.
  function prepare(header, arrays) {
    const count = header.count, bases = header.bases;
    const first = new Uint32Array(count + 1), axes = new Float32Array(9 * count);
    const weights = Float32Array.from(arrays.weights);
    for (let i = 0; i < count; i++) {
      first[i + 1] = first[i] + arrays.carriers[i];
      let sum = 0;
      for (let k = first[i]; k < first[i + 1]; k++) sum += weights[k];
      for (let k = first[i]; k < first[i + 1]; k++) weights[k] /= sum;
      const [x, y, z, w] = arrays.frames.subarray(4 * i, 4 * i + 4);
      axes.set(quaternionMatrix(w, x, y, z), 9 * i);
    }
    const place = new Int32Array(count).fill(-1);
    arrays.expressive.forEach((row, m) => { place[row] = m; });
    const motions = header.motions.map((one, k) => ({
      ...one,
      rotation: arrays[`motion${k}_rotation`],
      expression: arrays[`motion${k}_expression`],
      transl: arrays[`motion${k}_transl`],
      cameras: arrays[`motion${k}_cameras`],
    }));
    return {
      ...header, motions, count, bases, first, weights, axes, place,
      jointsOf: arrays.joints_of, points: arrays.points, joints: arrays.joints,
      scales: arrays.log_scales.map(Math.exp), colorLogit: arrays.color_logit,
      colorBases: transposed(arrays.color_bases, 3 * bases, count),
      moveBases: transposed(arrays.move_bases, 3 * bases, count),
      expressionMoves: arrays.expression_moves, // [3 E, M]: point by point, row c E + e
      expressive: arrays.expressive.length, expressionCount: header.expression_count,
      signal: { mean: arrays.signal_mean, components: arrays.signal_components, limits: arrays.signal_limits },
      opacities: arrays.opacities, trust: arrays.trust, parts: arrays.parts,
    };
  }

  function quaternionMatrix(w, x, y, z) {
    const s = 2 / (w * w + x * x + y * y + z * z);
    return [
      1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
      s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x),
      s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y),
    ];
  }

  // A rotation vector's matrix, by rows.
  function rotationMatrix(x, y, z) {
    const angle = Math.hypot(x, y, z);
    if (angle < 1e-9) return [1, -z, y, z, 1, -x, -y, x, 1];
    const s = Math.sin(angle / 2) / angle;
    return quaternionMatrix(Math.cos(angle / 2), s * x, s * y, s * z);
  }

  function product(a, b) {
    const found = new Array(9);
    for (let r = 0; r < 3; r++) for (let c = 0; c < 3; c++) {
      found[3 * r + c] = a[3 * r] * b[c] + a[3 * r + 1] * b[3 + c] + a[3 * r + 2] * b[6 + c];
    }
    return found;
  }

  function times(a, x, y, z) {
    return [0, 3, 6].map(r => a[r] * x + a[r + 1] * y + a[r + 2] * z);
  }

  // Local rotation matrices [55][9] -> the transforms that carry rest points, [55 * 12], rows of [R | t].
  function jointTransforms(avatar, local) {
    const found = new Float64Array(12 * local.length), turned = [], placed = [], J = avatar.joints;
    for (let j = 0; j < local.length; j++) {
      const up = avatar.parents[j], x = J[3 * j], y = J[3 * j + 1], z = J[3 * j + 2];
      if (up < 0) {
        turned[j] = local[j];
        placed[j] = [x, y, z];
      } else {
        turned[j] = product(turned[up], local[j]);
        const bone = times(turned[up], x - J[3 * up], y - J[3 * up + 1], z - J[3 * up + 2]);
        placed[j] = bone.map((value, k) => value + placed[up][k]);
      }
      const rest = times(turned[j], x, y, z);
      for (let r = 0; r < 3; r++) {
        found.set(turned[j].slice(3 * r, 3 * r + 3), 12 * j + 4 * r);
        found[12 * j + 4 * r + 3] = placed[j][r] - rest[r];
      }
    }
    return found;
  }

  // Pose and expression along the clip's principal directions, within what it showed, 0 at its mean: [B].
  function drivingSignal(avatar, local, expression) {
    const { mean, components, limits } = avatar.signal, told = new Float64Array(mean.length);
    for (let j = 1; j < local.length; j++) for (let r = 0; r < 3; r++) for (let c = 0; c < 2; c++) {
      told[6 * (j - 1) + 2 * r + c] = local[j][3 * r + c] - (r === c ? 1 : 0);
    }
    for (let e = 0; e < avatar.expressionCount; e++) told[6 * (local.length - 1) + e] = expression[e] || 0;
    const found = new Float64Array(avatar.bases);
    for (let b = 0; b < found.length; b++) {
      let sum = 0;
      for (let d = 0; d < told.length; d++) sum += components[b * told.length + d] * (told[d] - mean[d]);
      const low = limits[b], high = limits[found.length + b];
      found[b] = Math.min(Math.max(sum, low), high) - Math.max(low, 0) - Math.min(high, 0);
    }
    return found;
  }

  // The expression's offsets of the points that expressions move, [3 M], metres.
  function expressionOffsets(avatar, expression) {
    const M = avatar.expressive, E = avatar.expressionCount, found = new Float32Array(3 * M);
    for (let e = 0; e < E; e++) {
      const weight = expression[e] || 0;
      if (!weight) continue;
      for (let c = 0; c < 3; c++) {
        const row = (c * E + e) * M;
        for (let m = 0; m < M; m++) found[3 * m + c] += weight * avatar.expressionMoves[row + m];
      }
    }
    return found;
  }

  // A nearly orthonormal matrix, by rows -> the rotation of its quaternion, as skinning_kernels.py has it.
  function turnedAxes(m) {
    const trace = m[0] + m[4] + m[8];
    let i = m[4] > m[0] ? 1 : 0;
    if (m[8] > m[4 * i]) i = 2;
    if (trace >= m[4 * i]) return quaternionMatrix(1 + trace, m[7] - m[5], m[2] - m[6], m[3] - m[1]);
    const j = (i + 1) % 3, k = (i + 2) % 3, q = [0, 0, 0];
    q[i] = 1 - trace + 2 * m[4 * i];
    q[j] = m[3 * j + i] + m[3 * i + j];
    q[k] = m[3 * k + i] + m[3 * i + k];
    return quaternionMatrix(m[3 * k + j] - m[3 * j + k], ...q);
  }

  // The Gaussians of a pose, 16 floats each (see TEXEL).
  //   pose: local, [55][9] rotation matrices; expression; transl.
  function pose(avatar, { local, expression, transl }, found = new Float32Array(TEXEL * avatar.count)) {
    const T = jointTransforms(avatar, local), signal = drivingSignal(avatar, local, expression);
    const moved = expressionOffsets(avatar, expression), B = avatar.bases, six = new Float64Array(6);
    const blend = new Float64Array(12), m = new Float64Array(9), point = new Float64Array(3);
    const { first, weights, jointsOf, axes, points, place, scales, colorLogit, colorBases, moveBases } = avatar;
    for (let i = 0; i < avatar.count; i++) {
      for (let c = 0, at = 3 * B * i; c < 3; c++) {
        let color = 0, move = 0;
        for (let b = 0; b < B; b++, at++) {
          color += colorBases[at] * signal[b];
          move += moveBases[at] * signal[b];
        }
        six[c] = color;
        six[3 + c] = move;
      }
      for (let c = 0; c < 3; c++) {
        point[c] = points[3 * i + c] + six[3 + c] + (place[i] < 0 ? 0 : moved[3 * place[i] + c]);
      }
      blend.fill(0);
      for (let k = first[i]; k < first[i + 1]; k++) {
        const weight = weights[k], at = 12 * jointsOf[k];
        for (let n = 0; n < 12; n++) blend[n] += weight * T[at + n];
      }
      const to = TEXEL * i;
      for (let r = 0; r < 3; r++) {
        const x = blend[4 * r], y = blend[4 * r + 1], z = blend[4 * r + 2];
        found[to + r] = x * point[0] + y * point[1] + z * point[2] + blend[4 * r + 3] + transl[r];
        for (let c = 0; c < 3; c++) {
          m[3 * r + c] = x * axes[9 * i + c] + y * axes[9 * i + 3 + c] + z * axes[9 * i + 6 + c];
        }
        found[to + 9 + r] = 1 / (1 + Math.exp(-(colorLogit[3 * i + r] + six[r])));
      }
      found[to + 12] = avatar.opacities[i];
      covariance(turnedAxes(m), scales, 3 * i, found, to + 3);
    }
    return found;
  }

  function covariance(R, scales, at, found, to) {
    const a = scales[at] ** 2, b = scales[at + 1] ** 2, c = scales[at + 2] ** 2;
    for (let r = 0, n = 0; r < 3; r++) for (let s = r; s < 3; s++, n++) {
      found[to + n] = a * R[3 * r] * R[3 * s] + b * R[3 * r + 1] * R[3 * s + 1] + c * R[3 * r + 2] * R[3 * s + 2];
    }
  }

  return { unpack, pose, product, rotationMatrix, times, TEXEL };
})();

if (typeof module !== "undefined") module.exports = Posing;
