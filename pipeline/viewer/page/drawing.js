// Gaussians on a WebGL2 canvas: image formation as pipeline/splat/image_formation.py has it, with the same
// constants; sorted from back to front on the CPU and blended over the background by the GPU, in 8 bits.
"use strict";

const Drawing = (() => {
  const WIDTH = 1024; // texels of a row of the texture that holds the Gaussians

  const VERTEX = `#version 300 es
    precision highp float;
    precision highp int;
    precision highp sampler2D;
    uniform sampler2D gaussians;
    uniform mat3 rotation;     // world to camera
    uniform vec3 translation;
    uniform vec4 lens;         // fx, fy, cx, cy, pixels
    uniform vec2 size;         // of the image, pixels
    in vec2 corner;
    in uint which;
    out vec2 offset;           // from the mean, pixels
    flat out vec3 conic;
    flat out vec4 color;       // and opacity
    vec4 texel(uint k) {
      uint at = 4u * which + k;
      return texelFetch(gaussians, ivec2(at % ${WIDTH}u, at / ${WIDTH}u), 0);
    }
    void main() {
      vec4 a = texel(0u), b = texel(1u), c = texel(2u);
      vec3 p = rotation * a.xyz + translation;
      gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // outside
      if (p.z < 0.01) return;
      mat3 world = mat3(a.w, b.x, b.y, b.x, b.z, b.w, b.y, b.w, c.x);
      vec2 margin = 0.15 * size / lens.xy; // 0.3 of half the field of view
      vec2 low = -lens.zw / lens.xy - margin, high = (size - lens.zw) / lens.xy + margin;
      vec2 uv = clamp(p.xy / p.z, low, high);
      vec3 jx = lens.x / p.z * vec3(1.0, 0.0, -uv.x), jy = lens.y / p.z * vec3(0.0, 1.0, -uv.y);
      mat3 seen = rotation * world * transpose(rotation);
      float xx = dot(jx, seen * jx) + 0.3, xy = dot(jx, seen * jy), yy = dot(jy, seen * jy) + 0.3;
      float determinant = max(xx * yy - xy * xy, 1e-6);
      conic = vec3(0.5 * yy, -xy, 0.5 * xx) / determinant;
      color = vec4(c.yzw, texel(3u).x);
      if (255.0 * color.a < 1.0) return;
      float middle = 0.5 * (xx + yy), half_ = sqrt(max(middle * middle - determinant, 0.0));
      float long_ = middle + half_, short_ = max(middle - half_, 0.0);
      vec2 axis = abs(xy) > 1e-6 ? normalize(vec2(xy, long_ - xx)) : (xx >= yy ? vec2(1, 0) : vec2(0, 1));
      float reach = sqrt(2.0 * log(255.0 * color.a));
      offset = reach * (corner.x * sqrt(long_) * axis + corner.y * sqrt(short_) * vec2(-axis.y, axis.x));
      vec2 pixel = lens.xy * p.xy / p.z + lens.zw + offset;
      gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
    }`;

  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec2 offset;
    flat in vec3 conic;
    flat in vec4 color;
    out vec4 found;
    void main() {
      float sigma = conic.x * offset.x * offset.x + conic.y * offset.x * offset.y + conic.z * offset.y * offset.y;
      float alpha = min(0.999, color.a * exp(-sigma));
      if (alpha < 1.0 / 255.0) discard;
      found = vec4(alpha * color.rgb, alpha);
    }`;

  function compiled(gl) {
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  // The numbers of the Gaussians to draw, the farthest first: a counting sort of 16-bit depths.
  //   data: 16 floats each; shown: 1 for those to draw; camera: see Renderer.draw.
  function sorted(data, count, shown, camera, found) {
    const a = camera[12], b = camera[13], c = camera[14], d = camera[17], depths = sorted.depths(count);
    let low = Infinity, high = -Infinity, left = 0;
    for (let i = 0; i < count; i++) {
      if (!shown[i]) continue;
      const depth = a * data[16 * i] + b * data[16 * i + 1] + c * data[16 * i + 2] + d;
      depths[i] = depth;
      if (depth < low) low = depth;
      if (depth > high) high = depth;
      left++;
    }
    const scale = 65535 / Math.max(high - low, 1e-9), places = sorted.places.fill(0);
    for (let i = 0; i < count; i++) if (shown[i]) places[65535 - ((depths[i] - low) * scale | 0)]++;
    for (let k = 0, sum = 0; k < 65536; k++) {
      const here = places[k];
      places[k] = sum;
      sum += here;
    }
    for (let i = 0; i < count; i++) if (shown[i]) found[places[65535 - ((depths[i] - low) * scale | 0)]++] = i;
    return left;
  }
  sorted.places = new Uint32Array(65536);
  sorted.room = new Float32Array(0);
  sorted.depths = count => {
    if (sorted.room.length < count) sorted.room = new Float32Array(count);
    return sorted.room;
  };

  class Renderer {
    // Throws where the canvas has no WebGL2.
    constructor(canvas) {
      const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, preserveDrawingBuffer: true });
      if (!gl) throw new Error("no WebGL2");
      this.canvas = canvas;
      this.gl = gl;
      this.program = compiled(gl);
      this.uniforms = {};
      for (const name of ["gaussians", "rotation", "translation", "lens", "size"]) {
        this.uniforms[name] = gl.getUniformLocation(this.program, name);
      }
      this.texture = gl.createTexture();
      this.order = gl.createBuffer();
      this.numbers = new Uint32Array(0);
      this.rows = 0;
      this._attribute("corner", gl.createBuffer(), 2, gl.FLOAT, 0);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
      this._attribute("which", this.order, 1, gl.UNSIGNED_INT, 1);
    }

    _attribute(name, buffer, width, kind, divisor) {
      const gl = this.gl, at = gl.getAttribLocation(this.program, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.enableVertexAttribArray(at);
      if (kind === gl.FLOAT) gl.vertexAttribPointer(at, width, kind, false, 0, 0);
      else gl.vertexAttribIPointer(at, width, kind, 0, 0);
      gl.vertexAttribDivisor(at, divisor);
    }

    // Takes the Gaussians of a pose, 16 floats each.
    take(data, count) {
      const gl = this.gl, rows = Math.ceil(4 * count / WIDTH);
      if (this.rows !== rows) {
        this.room = new Float32Array(4 * WIDTH * rows);
        this.numbers = new Uint32Array(count);
      }
      if (this.numbers.length !== count) this.numbers = new Uint32Array(count);
      this.room.set(data.subarray(0, 16 * count));
      this.data = data;
      this.count = count;
      gl.bindTexture(gl.TEXTURE_2D, this.texture);
      if (this.rows !== rows) {
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, WIDTH, rows, 0, gl.RGBA, gl.FLOAT, this.room);
        for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
        this.rows = rows;
      } else gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, rows, gl.RGBA, gl.FLOAT, this.room);
    }

    // Draws what was taken.
    //   camera: fx, fy, cx, cy, width, height (pixels of the canvas), rotation by rows, translation.
    //   shown: 1 for each Gaussian to draw; background: RGB in [0, 1].
    draw(camera, shown, background) {
      const gl = this.gl, [fx, fy, cx, cy, width, height, ...placed] = camera;
      const left = sorted(this.data, this.count, shown, camera, this.numbers);
      gl.viewport(0, 0, width, height);
      gl.clearColor(...background, 1);
      gl.clear(gl.COLOR_BUFFER_BIT);
      gl.useProgram(this.program);
      gl.bindTexture(gl.TEXTURE_2D, this.texture);
      gl.uniform1i(this.uniforms.gaussians, 0);
      gl.uniformMatrix3fv(this.uniforms.rotation, true, placed.slice(0, 9));
      gl.uniform3f(this.uniforms.translation, ...placed.slice(9));
      gl.uniform4f(this.uniforms.lens, fx, fy, cx, cy);
      gl.uniform2f(this.uniforms.size, width, height);
      gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
      gl.bufferData(gl.ARRAY_BUFFER, this.numbers.subarray(0, left), gl.DYNAMIC_DRAW);
      gl.disable(gl.DEPTH_TEST);
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, left);
    }
  }

  return { Renderer, sorted };
})();

if (typeof module !== "undefined") module.exports = Drawing;
