// The page's controls: an orbit camera, sliders for pose and expression, motions, colourings, and following
// the server where there is one.
"use strict";

const Viewer = (() => {
  const FIELD = 25 * Math.PI / 180; // of view, along the image's height, as pipeline/orbit_cameras.py
  const GREY = [0.82, 0.82, 0.82], GUESSED = [0.95, 0.35, 0.10], SURE = 0.5;
  const NO_BASIS = [1, 0, 0, 0, 1, 0, 0, 0, 1];
  const FOLLOW = 2000; // milliseconds between two questions to the server

  // Sliders that turn joints: label, [joint, axis, share] of each, limits in radians.
  const TURNS = [
    ["head", "turn", [["neck", 1, 0.5], ["head", 1, 0.5]], -1.2, 1.2],
    ["head", "nod", [["neck", 0, 0.5], ["head", 0, 0.5]], -0.7, 0.7],
    ["head", "tilt", [["neck", 2, 0.5], ["head", 2, 0.5]], -0.6, 0.6],
    ["face", "jaw", [["jaw", 0, 1]], 0, 0.5],
    ["face", "eyes across", [["left_eye", 1, 1], ["right_eye", 1, 1]], -0.6, 0.6],
    ["face", "eyes down", [["left_eye", 0, 1], ["right_eye", 0, 1]], -0.4, 0.4],
    ["left arm", "left arm up", [["left_shoulder", 2, 1]], -0.5, 2],
    ["left arm", "left arm forward", [["left_shoulder", 1, -1]], -0.5, 1.6],
    ["left arm", "left elbow", [["left_elbow", 1, -1]], 0, 2.2],
    ["right arm", "right arm up", [["right_shoulder", 2, -1]], -0.5, 2],
    ["right arm", "right arm forward", [["right_shoulder", 1, 1]], -0.5, 1.6],
    ["right arm", "right elbow", [["right_elbow", 1, 1]], 0, 2.2],
  ];

  function element(kind, fields = {}, ...children) {
    const found = Object.assign(document.createElement(kind), fields);
    found.append(...children);
    return found;
  }

  function partColor(part, parts) {
    const hue = 6 * part / parts;
    return [0, 2, 4].map(shift => {
      const k = Math.abs((hue + shift) % 6 - 3);
      return 0.25 + 0.65 * Math.min(Math.max(k - 1, 0), 1);
    });
  }

  class View {
    constructor(root) {
      this.root = root;
      this.canvas = root.querySelector("canvas");
      this.values = {}; // of the sliders, by label
      this.yaw = 0;
      this.pitch = 0;
      this.zoom = 1;
      this.pan = [0, 0];
      this.frame = 0;
      this.playing = false;
      this.colouring = "own";
      this.guessed = true;
      this.filmedView = false;
      this.intervals = [];
      this.renderer = new Drawing.Renderer(this.canvas);
      this.canvas.addEventListener("webglcontextlost", () => this.say("The graphics were taken away: load the page again."));
    }

    say(words) {
      this.root.querySelector(".said").textContent = words;
    }

    // Takes an avatar in place of the one before; sliders and camera stay as they are.
    take(avatar) {
      const first = !this.avatar;
      this.avatar = avatar;
      this.index = Object.fromEntries(avatar.joint_names.map((name, j) => [name, j]));
      this.shown = new Uint8Array(avatar.count).fill(1);
      this.parts = avatar.part_names.map((_, part) => partColor(part, avatar.part_names.length));
      this.showGuessed(this.guessed);
      if (first) {
        this.build();
        this.choose(0);
        this.listen();
        new ResizeObserver(() => this.change()).observe(this.canvas);
      } else {
        if (this.motion >= avatar.motions.length) this.choose(0);
        this.change(true);
      }
    }

    // ---- the page's parts

    build() {
      const box = this.root.querySelector(".knobs"), avatar = this.avatar, groups = {};
      const motions = element("select", { title: "what it does" }, element("option", { textContent: "stand still", value: "-1" }));
      avatar.motions.forEach((one, k) => motions.append(element("option", { textContent: one.name, value: String(k) })));
      this.motions = motions;
      motions.addEventListener("change", () => this.choose(Number(motions.value)));
      this.button = element("button", { type: "button", textContent: "play", className: "play" });
      this.button.addEventListener("click", () => this.play(!this.playing));
      this.time = element("input", { type: "range", min: 0, max: 0, step: 1, value: 0, className: "time" });
      this.time.setAttribute("aria-label", "frame");
      this.time.addEventListener("input", () => { this.frame = Number(this.time.value); this.change(true); });
      const colours = element("select", { className: "colours", title: "colours" });
      for (const [value, label] of [["own", "its own colours"], ["evidence", "evidence: orange was guessed"], ["parts", "parts of the body"]]) {
        colours.append(element("option", { value, textContent: label }));
      }
      colours.addEventListener("change", () => { this.colouring = colours.value; this.change(true); });
      const guessed = element("input", { type: "checkbox", checked: true, className: "guessed" });
      guessed.addEventListener("change", () => { this.showGuessed(guessed.checked); this.change(); });
      this.filmed = element("input", { type: "checkbox", className: "filmed" });
      this.filmed.addEventListener("change", () => { this.filmedView = this.filmed.checked; this.change(); });
      this.filmedLabel = element("label", {}, this.filmed, " as the camera saw it");
      const reset = element("button", { type: "button", textContent: "reset", className: "reset" });
      reset.addEventListener("click", () => this.reset());
      box.append(element("div", { className: "line" }, motions, this.button, this.time, reset));
      box.append(element("div", { className: "line" }, colours, element("label", {}, guessed, " guessed surface"), this.filmedLabel));
      for (const [group, label, , low, high] of TURNS) {
        groups[group] = groups[group] || box.appendChild(element("details", { open: group === "head" || group === "face" }, element("summary", { textContent: group })));
        groups[group].append(this.slider(label, low, high));
      }
      if (avatar.expressions.length) {
        const all = box.appendChild(element("details", {}, element("summary", { textContent: "expression" })));
        for (const one of avatar.expressions) all.append(this.slider(one.name, 0, 1));
      }
    }

    slider(label, low, high) {
      const input = element("input", { type: "range", min: low, max: high, step: 0.01, value: 0 });
      input.dataset.name = label;
      input.addEventListener("input", () => { this.values[label] = Number(input.value); this.change(true); });
      return element("label", { className: "knob" }, element("span", { textContent: label }), input);
    }

    reset() {
      this.values = {};
      for (const one of this.root.querySelectorAll(".knob input")) one.value = 0;
      [this.yaw, this.pitch, this.zoom, this.pan] = [0, 0, 1, [0, 0]];
      this.change(true);
    }

    showGuessed(shown) {
      this.guessed = shown;
      for (let i = 0; i < this.avatar.count; i++) this.shown[i] = shown || this.avatar.trust[i] >= SURE ? 1 : 0;
    }

    // Chooses a motion by its number; -1: stand still.
    choose(motion) {
      const one = this.avatar.motions[motion];
      this.motion = one ? motion : -1;
      this.motions.value = String(this.motion);
      this.frame = 0;
      this.time.max = one ? one.frames - 1 : 0;
      this.time.value = 0;
      this.time.disabled = this.button.disabled = !one || one.frames < 2;
      this.filmedLabel.hidden = !one || !one.filmed;
      this.filmedView = this.filmedView && !this.filmedLabel.hidden;
      this.filmed.checked = this.filmedView;
      this.play(false);
      this.change(true);
      this.aim();
    }

    play(on) {
      this.playing = on && !this.button.disabled;
      this.button.textContent = this.playing ? "stop" : "play";
      this.started = [performance.now(), this.frame];
      if (this.playing) this.change(true);
    }

    // ---- pose and camera

    // The pose that motion and sliders make together: local rotation matrices, expression, transl.
    pose() {
      const avatar = this.avatar, one = avatar.motions[this.motion], joints = avatar.joint_names.length, local = [];
      const still = avatar.still_pose, at = this.frame;
      for (let j = 0; j < joints; j++) {
        const from = one ? one.rotation.subarray(3 * (at * joints + j)) : still.slice(3 * j, 3 * j + 3);
        local.push(Posing.rotationMatrix(from[0], from[1], from[2]));
      }
      for (const [, label, turned] of TURNS) {
        for (const [joint, axis, share] of this.values[label] ? turned : []) {
          const turn = [0, 0, 0], j = this.index[joint];
          turn[axis] = share * this.values[label];
          local[j] = Posing.product(local[j], Posing.rotationMatrix(...turn));
        }
      }
      const count = avatar.expressionCount, width = one ? one.expression.length / one.frames : 0;
      const expression = new Float64Array(count);
      for (let e = 0; e < Math.min(count, width); e++) expression[e] = one.expression[at * width + e];
      for (const { name, coefficients } of avatar.expressions) {
        const weight = this.values[name] || 0;
        if (weight) coefficients.forEach((value, e) => { expression[e] += weight * value; });
      }
      return { local, expression, transl: one ? one.transl.subarray(3 * at, 3 * at + 3) : [0, 0, 0] };
    }

    // World to a frame with Y up and the first camera in front.
    basis() {
      const one = this.avatar.motions[this.motion];
      if (!one || !one.filmed) return NO_BASIS;
      const R = one.cameras.subarray(6, 15);
      return [R[0], R[1], R[2], -R[3], -R[4], -R[5], -R[6], -R[7], -R[8]];
    }

    // Aims the orbit at the Gaussians as they are in some frames of the motion, the first among them.
    aim() {
      const one = this.avatar.motions[this.motion], frames = one ? [0.75, 0.5, 0.25, 0].map(part => part * one.frames | 0) : [0];
      const lists = [[], [], []];
      for (const frame of new Set(frames)) {
        this.frame = frame;
        this.gather(lists);
      }
      const ends = lists.map(one => { one.sort((a, b) => a - b); return [one[one.length * 0.002 | 0], one[one.length * 0.998 | 0]]; });
      this.centre = ends.map(([low, high]) => (low + high) / 2);
      this.reach = ends.map(([low, high]) => Math.max((high - low) / 2, 0.05));
      this.change();
    }

    // Adds the places of the Gaussians, in the frame with Y up, to three lists.
    gather(lists) {
      this.repose();
      const basis = this.basis(), data = this.data, step = Math.max(1, this.avatar.count / 4000 | 0);
      for (let i = 0; i < this.avatar.count; i += step) {
        const place = Posing.times(basis, data[Posing.TEXEL * i], data[Posing.TEXEL * i + 1], data[Posing.TEXEL * i + 2]);
        for (let c = 0; c < 3; c++) lists[c].push(place[c]);
      }
    }

    // The camera of the orbit, or the one that filmed, for a canvas of so many pixels.
    camera(width, height) {
      const one = this.avatar.motions[this.motion];
      if (this.filmedView && one && one.filmed) {
        const [fx, fy, cx, cy, w, h, ...placed] = one.cameras.subarray(18 * this.frame, 18 * this.frame + 18);
        const scale = Math.min(width / w, height / h);
        const left = (width - scale * w) / 2, top = (height - scale * h) / 2;
        return [scale * fx, scale * fy, scale * cx + left, scale * cy + top, width, height, ...placed];
      }
      const focal = height / 2 / Math.tan(FIELD / 2);
      const radius = Math.hypot(this.reach[0], this.reach[2]);
      const needed = Math.max(1.1 * this.reach[1] * focal / (height / 2), 1.1 * radius * focal / (width / 2));
      return this.orbit(width, height, (needed + radius) / this.zoom);
    }

    orbit(width, height, distance) {
      const [s, c, sp, cp] = [Math.sin(this.yaw), Math.cos(this.yaw), Math.sin(this.pitch), Math.cos(this.pitch)];
      const right = [c, 0, -s], ahead = [-s, 0, -c];
      const down = [-sp * ahead[0], -cp, -sp * ahead[2]], forward = [cp * ahead[0], -sp, cp * ahead[2]];
      const focal = height / 2 / Math.tan(FIELD / 2), level = [...right, ...down, ...forward];
      const shift = Posing.times(level, ...this.centre);
      const place = [this.pan[0] - shift[0], this.pan[1] - shift[1], distance - shift[2]];
      return [focal, focal, width / 2, height / 2, width, height, ...Posing.product(level, this.basis()), ...place];
    }

    // ---- drawing

    repose() {
      const avatar = this.avatar;
      if (!this.data || this.data.length !== Posing.TEXEL * avatar.count) this.data = new Float32Array(Posing.TEXEL * avatar.count);
      Posing.pose(avatar, this.pose(), this.data);
      if (this.colouring !== "own") this.recolour();
      this.renderer.take(this.data, avatar.count);
    }

    recolour() {
      const { count, trust, parts } = this.avatar, data = this.data;
      for (let i = 0; i < count; i++) {
        const to = Posing.TEXEL * i + 9;
        if (this.colouring === "parts") data.set(this.parts[parts[i]], to);
        else for (let c = 0; c < 3; c++) data[to + c] = trust[i] * data[to + c] + (1 - trust[i]) * GUESSED[c];
      }
    }

    // Asks for a picture; posed: the pose has changed, too.
    change(posed = false) {
      this.stale = this.stale || posed;
      if (this.asked || !this.avatar) return;
      this.asked = requestAnimationFrame(() => { this.asked = 0; this.show(); });
    }

    show() {
      const start = performance.now(), one = this.avatar.motions[this.motion];
      if (this.playing && one) {
        const [since, from] = this.started;
        this.frame = (from + Math.floor((start - since) / 1000 * one.fps)) % one.frames;
        this.time.value = this.frame;
        this.stale = true;
      }
      if (this.stale) this.repose();
      this.stale = false;
      const scale = Math.min(devicePixelRatio || 1, 2);
      const width = Math.max(1, Math.round(this.canvas.clientWidth * scale));
      const height = Math.max(1, Math.round(this.canvas.clientHeight * scale));
      if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
      this.draw(this.camera(width, height));
      this.count(start);
      if (this.onFrame) this.onFrame();
      if (this.playing) this.change(true);
    }

    draw(camera) {
      this.renderer.draw(camera, this.shown, GREY);
    }

    count(now) {
      const apart = now - (this.drawn || 0);
      this.drawn = now;
      this.intervals = apart < 1000 ? [...this.intervals, apart].slice(-20) : [];
      const mean = this.intervals.reduce((sum, one) => sum + one, 0) / this.intervals.length;
      const rate = this.intervals.length > 2 ? `, ${(1000 / mean).toFixed(mean > 100 ? 1 : 0)} frames a second` : "";
      this.say(`${this.avatar.count.toLocaleString("en")} Gaussians${rate}. ${this.news || "Drag to turn, scroll or pinch to come nearer, two fingers or Shift to move."}`);
    }

    // ---- fingers and mice

    listen() {
      const canvas = this.canvas, down = new Map();
      canvas.addEventListener("pointerdown", event => { canvas.setPointerCapture(event.pointerId); down.set(event.pointerId, event); });
      for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, event => down.delete(event.pointerId));
      canvas.addEventListener("pointermove", event => {
        const before = down.get(event.pointerId);
        if (!before) return;
        const x = event.clientX - before.clientX, y = event.clientY - before.clientY;
        if (down.size === 1 && !event.shiftKey) {
          this.yaw -= 0.01 * x;
          this.pitch = Math.min(Math.max(this.pitch + 0.01 * y, -1.5), 1.5);
        } else {
          const unit = 2 * this.reach[1] / this.zoom / canvas.clientHeight / down.size;
          this.pan = [this.pan[0] + unit * x, this.pan[1] + unit * y];
          if (down.size === 2) this.pinch(down, before, event);
        }
        down.set(event.pointerId, event);
        this.change();
      });
      canvas.addEventListener("wheel", event => {
        event.preventDefault();
        this.nearer(Math.exp(-0.001 * event.deltaY));
      }, { passive: false });
    }

    pinch(down, before, event) {
      const other = [...down.values()].find(one => one.pointerId !== event.pointerId);
      const apart = one => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY) + 1;
      this.nearer(apart(event) / apart(before));
    }

    nearer(factor) {
      this.zoom = Math.min(Math.max(this.zoom * factor, 0.2), 20);
      this.change();
    }
  }

  // ---- where the avatar comes from

  function embedded(text) {
    const raw = atob(text.trim()), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    return bytes;
  }

  async function fetched(what) {
    const answer = await fetch(what, { cache: "no-store" });
    if (!answer.ok) throw new Error((await answer.text()).slice(0, 300) || answer.statusText);
    return answer;
  }

  // Asks the server again and again whether there is another avatar, and shows the filmed frame.
  async function follow(view) {
    const picture = view.root.querySelector(".filmed-frame");
    view.onFrame = () => {
      const one = view.avatar.motions[view.motion], number = one && one.numbers.length ? one.numbers[view.frame] : undefined;
      picture.hidden = number === undefined;
      const place = `frame/${number}`;
      if (!picture.hidden && picture.dataset.place !== place && (picture.complete || !picture.dataset.place)) {
        picture.dataset.place = place;
        picture.src = place;
      }
    };
    for (let stamp = ""; ;) {
      try {
        const state = await (await fetched("state")).json();
        view.news = state.said;
        if (state.stamp !== stamp) {
          view.take(await Posing.unpack(await (await fetched("avatar")).arrayBuffer()));
          stamp = state.stamp;
        }
      } catch (error) {
        if (!view.avatar) view.say(String(error.message || error));
        else view.news = "The server has ended or cannot read the avatar; this is the last one.";
      }
      await new Promise(done => setTimeout(done, FOLLOW));
    }
  }

  // The page without the avatar: a line, and the film of its turn where the page has one.
  function without(root, reason) {
    const film = root.querySelector(".film");
    root.classList.add("without");
    root.querySelector(".said").textContent = `${reason}: ${film ? "here is the film of its turn instead" : "its turn is filmed in turntable.mp4"}.`;
    if (film) film.hidden = false;
  }

  async function start(root) {
    let view;
    try {
      view = new View(root);
      if (typeof DecompressionStream === "undefined") throw new Error("it is too old");
    } catch (error) {
      without(root, `This browser cannot draw the avatar (${error.message})`);
      return null;
    }
    const data = root.querySelector("script[type='text/plain']");
    if (!data) return follow(view), view;
    try {
      view.take(await Posing.unpack(embedded(data.textContent)));
    } catch (error) {
      without(root, `The avatar in this page cannot be read (${error.message})`);
    }
    return view;
  }

  // Starts when the page comes into sight, so that a report opens at once.
  const root = document.querySelector(".avatar-view");
  const page = { view: null };
  new IntersectionObserver(async (entries, observer) => {
    if (!entries.some(one => one.isIntersecting)) return;
    observer.disconnect();
    page.view = await start(root);
  }).observe(root);
  return page;
})();

window.avatarPage = Viewer;
