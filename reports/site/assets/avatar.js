// The avatar tab: a person that turns and moves, painted by what training showed of it.

const PARTS = { visible: 1, hidden: 2, never_seen: 3 }; // labels; `painted` is a bit of its own
const LIMBS = { // sliders: joints that turn together, about axes of SMPL's rest pose, per radian
  "arms up": { 16: [0, 0, 1], 17: [0, 0, -1] },
  "arms forward": { 16: [0, -1, 0], 17: [0, 1, 0] },
  "elbows": { 18: [0, -1, 0], 19: [0, 1, 0] },
  "head": { 12: [0, 0.5, 0], 15: [0, 0.5, 0] },
  "bend": { 3: [0.4, 0, 0], 6: [0.3, 0, 0], 9: [0.3, 0, 0] },
  "knees": { 1: [-0.6, 0, 0], 2: [-0.6, 0, 0], 4: [1, 0, 0], 5: [1, 0, 0] },
};
const FIELD = 30; // degrees of the free camera
const FAR = 30; // dB of a price below which the page says so
const held = { yaw: 20, pitch: 8, zoom: 1, limbs: {}, tints: new Set(), playing: true, t: 0, stepped: null };
const unpackedAvatars = new Map(); // run -> promise

function avatarTab(group, g, of) {
  const runs = group.runs.filter((k) => DATA.avatars[k]);
  if (!runs.length) return el("p", {}, "No run of this group has left an avatar.");
  const run = runs.includes(Number(of.get("run") ?? NaN)) ? Number(of.get("run")) : runs[0];
  const about = DATA.avatars[run];
  const scene = DATA.frames.find((s) => s.group === g && s.runs.includes(run));
  const views = (scene?.views ?? []).filter((v) => v.pose);
  const view = views.find((v) => v.camera === of.get("camera") && String(v.frame) === of.get("frame")) ?? null;
  const motions = Object.keys(DATA.motions[about.capture] ?? {}).concat(Object.keys(DATA.motions.shared ?? {}));
  const motion = motions.includes(of.get("motion")) ? of.get("motion") : of.get("motion") === "rest" || view ? null : motions.find((m) => m === "march") ?? null;
  if (of.has("t")) { held.t = Number(of.get("t")); held.playing = false; }
  if (of.has("yaw")) held.yaw = Number(of.get("yaw"));
  if (of.has("pitch")) held.pitch = Number(of.get("pitch"));
  const head = el("div", { class: "bar" },
    choice("run", runs.map((k) => [k, `${DATA.runs[k].label} on ${DATA.runs[k].scene}, seed ${DATA.runs[k].seed}`]), run,
      (v) => go("avatar", { group: g, run: v, motion: of.get("motion") })),
    choice("seen from", [["", "anywhere"], ...views.map((v) => [`${v.camera}/${v.frame}`, `test view ${v.camera}/${v.frame}`])],
      view ? `${view.camera}/${view.frame}` : "", (v) => {
        const [camera, frame] = v ? cut(v) : [null, null];
        go("avatar", { group: g, run, camera, frame });
      }),
    choice("motion", [["rest", view ? "as in that view" : "A-pose"], ...motions.map((m) => [m, m])], motion ?? "rest",
      (v) => { held.playing = true; held.t = 0; go("avatar", { group: g, run, camera: of.get("camera"), frame: of.get("frame"), motion: v }); }));
  if (about.reason) return [head, el("p", {}, `${about.turntable.length ? "It turns, but does not move here" : "It cannot be shown"}: ${about.reason}.`), turntable(about)];
  return [head, viewer(run, about, view, motion)];
}

// Pictures of the avatar from around: for methods that cannot be skinned in a page, and where there is no WebGL2.
function turntable(about) {
  if (!about.turntable.length) return null;
  const image = picture(about.turntable[0], "the avatar from the front", { class: "still", tabindex: "0" });
  const slider = el("input", { type: "range", min: "0", max: String(about.turntable.length - 1), value: "0", "aria-label": "turn",
    oninput: () => { image.src = pictureUrl(about.turntable[slider.value]); } });
  const turn = (n) => {
    slider.value = String((Number(slider.value) + n + about.turntable.length) % about.turntable.length);
    image.src = pictureUrl(about.turntable[slider.value]);
  };
  keys.ArrowLeft = () => turn(-1);
  keys.ArrowRight = () => turn(1);
  let from = null;
  image.addEventListener("pointerdown", (event) => { image.setPointerCapture(event.pointerId); from = event.clientX; });
  image.addEventListener("pointermove", (event) => {
    if (!event.buttons || from === null || Math.abs(event.clientX - from) < 14) return;
    turn(event.clientX > from ? 1 : -1);
    from = event.clientX;
  });
  return el("div", { class: "avatar" }, el("div", {}, image, slider));
}

function viewer(run, about, view, motion) {
  const clip = motion && (DATA.motions[about.capture]?.[motion] ?? DATA.motions.shared[motion]);
  if (clip) clip.name = motion;
  const canvas = el("canvas", { tabindex: "0", "aria-label": "the avatar; drag or use the arrow keys to turn, + and - to come near",
    width: 512, height: 512 });
  const place = el("div", {}, canvas);
  const said = el("p", { class: "note", "aria-live": "polite" }, "unpacking…");
  const slider = el("input", { type: "range", min: "0", max: "1000", value: String(Math.round(1000 * held.t)), "aria-label": "time",
    oninput: () => { held.playing = false; held.t = slider.value / 1000; pause.textContent = "play"; changed(); } });
  const pause = button(held.playing ? "pause" : "play", () => {
    held.playing = !held.playing;
    pause.textContent = held.playing ? "pause" : "play";
    changed();
  }, { title: "key: space" });
  let splats = null, avatar = null, frame = null, last = null, ended = false;
  const changed = () => { frame ??= requestAnimationFrame(draw); };
  const give = (reason) => {
    if (ended) return;
    ended = true;
    place.replaceChildren(el("p", { class: "note" }, `${reason}; here are pictures of it.`), turntable(about) ?? "");
  };

  const pose = () => posed(avatar, view, clip);
  const camera = () => (view ? fixedCamera(view) : { ...freeCamera(avatar, canvas), grain: about.pixel });
  function draw(now) {
    frame = null;
    if (ended || !splats) return;
    if (clip && held.playing) {
      if (last !== null) held.t = (held.t + (now - last) / 1000 * clip.fps / clip.frames) % 1;
      slider.value = String(Math.round(1000 * held.t));
      last = now;
      changed();
    } else last = null;
    splats.draw(pose(), camera(), tints());
    canvas.dataset.drawn = String(Number(canvas.dataset.drawn ?? 0) + 1);
  }
  function tints() {
    let bits = 0;
    for (const [name, label] of Object.entries(PARTS)) if (held.tints.has(name)) bits |= 1 << label;
    return bits | (held.tints.has("painted") ? 256 : 0);
  }
  unpackedAvatars.has(run) || unpackedAvatars.set(run, unpacked(about));
  unpackedAvatars.get(run).then((one) => {
    if (ended) return;
    avatar = one;
    splats = new Splats(canvas, give);
    splats.load(avatar);
    canvas.readback = () => splats.pixels(); // for checks: what was drawn, premultiplied
    const bytes = fileText(about.own).length * 0.75 + fileText(about.skin).length * 0.75;
    said.textContent = `${avatar.count.toLocaleString("en")} Gaussians, ${(bytes / 2 ** 20).toFixed(2)} MB in this page.${view || !about.pixel ? "" : " Drawn no finer than it was photographed."}`;
    changed();
  }).catch((error) => give(String(error.message ?? error)));
  leaving = () => {
    ended = true;
    if (frame !== null) cancelAnimationFrame(frame);
    splats?.close();
  };
  steer(canvas, changed);
  keys[" "] = () => pause.click();
  const limb = (name) => el("label", { class: "row" }, el("span", {}, name), el("input", {
    type: "range", min: "-150", max: "150", value: String(100 * (held.limbs[name] ?? 0)), "aria-label": name,
    oninput: (event) => { held.limbs[name] = event.target.value / 100; changed(); } }));
  const reset = () => { held.limbs = {}; Object.assign(held, { yaw: 20, pitch: 8, zoom: 1 }); show(); };
  const counts = about.labels;
  const tint = (name, words) => counts[name] > 0 && toggle(`${words} ${percent(counts[name])}`, held.tints.has(name), (on) => {
    on ? held.tints.add(name) : held.tints.delete(name);
    show();
  }, { class: `chip ${name}` });
  return el("div", { class: "avatar" }, el("div", {}, place, clip && el("div", { class: "bar" }, pause), clip && slider, said, price(about, view, motion)),
    el("div", {},
      el("fieldset", {}, el("legend", {}, "paint what training showed of the surface"), el("div", { class: "chips" },
        tint("visible", "visible"), tint("hidden", "hidden"), tint("never_seen", "never seen"), tint("painted", "painted"),
        !Object.values(counts).some((n) => n > 0) && el("span", { class: "note" }, "unknown: the data of this run were not at hand")),
      counts.painted > 0 && el("p", { class: "note" }, "Painted: a painter made what was learned there at least as often as it was seen.")),
      el("fieldset", {}, el("legend", {}, "joints"), Object.keys(LIMBS).map(limb), button("reset", reset, { class: "quiet" })),
      view && el("div", { class: "panes" }, [["truth", view.truth], ["the method's own drawing", view.predictions[run]]].map(([words, name]) =>
        name && el("figure", {}, cropped(view, el("div", { class: "layer" }, picture(name, words))), el("figcaption", {}, words))))));
}

function percent(share) {
  return `${(100 * share).toFixed(share < 0.1 ? 1 : 0)}%`;
}

// What is lost by putting the avatar into a page, beside the method's own drawing by the bench.
function price(about, view, motion) {
  const words = ([psnr, iou]) => `${psnr === null ? "—" : psnr === "inf" ? "∞" : psnr.toFixed(1)} dB in the person, silhouettes ${iou === null ? "—" : iou.toFixed(4)}`;
  const here = view && !motion && about.price[`${view.camera}/${view.frame}`];
  const moved = about.price[`motion ${motion}`];
  const every = Object.entries(about.price).filter(([name]) => !name.startsWith("motion ")).map(([, p]) => p);
  const finite = every.map(([p]) => p).filter((p) => typeof p === "number");
  return el("p", { class: "note price" }, "Price of baking, against the method's own drawing by the bench's renderer: ",
    here ? `this view ${words(here)}; ` : "", moved ? `${motion} ${words(moved)}; ` : "",
    finite.length ? `worst of ${every.length} test views ${Math.min(...finite).toFixed(1)} dB.` : "not measured.",
    Object.values(about.price).some(([p]) => typeof p === "number" && p < FAR) && el("b", {},
      " What moves here is not quite what the method draws: part of it depends on the pose or on the direction of view."));
}

// Joint transforms of the moment: the motion's, or the view's, or the A-pose, with the sliders on top.
function posed(avatar, view, clip) {
  const angles = new Float64Array(72);
  let transl = [0, 0, 0];
  if (view) {
    angles.set(view.pose);
    transl = view.transl;
  } else angles.set(DATA.a_pose);
  if (clip) {
    const at = Math.min(clip.frames - 1, Math.floor(held.t * clip.frames + 1e-6));
    clip.values ??= new Int16Array(bytesOf(clip.pose).buffer);
    // before a test view's camera the person stays where it is: only what hangs on the root moves
    for (let k = view ? 3 : 0; k < 72; k++) angles[k] = clip.values[72 * at + k] / 1e4;
  }
  const rotations = [];
  for (let j = 0; j < JOINTS; j++) {
    let R = rotation(angles[3 * j], angles[3 * j + 1], angles[3 * j + 2]);
    for (const [name, joints] of Object.entries(LIMBS)) {
      const by = held.limbs[name];
      if (by && joints[j]) R = times(rotation(...joints[j].map((v) => v * by)), R);
    }
    rotations.push(R);
  }
  const name = clip ? `motion ${clip.name}` : view ? `view ${view.camera}/${view.frame}` : "rest";
  return chain(rotations, avatar.joints, DATA.parents, transl, beyond(avatar.corrections, name, clip ? held.t * clip.frames : 0));
}

// [288] what the method does to the joints itself at a frame of a clip, between two samples on a line; null for nothing
function beyond(of, name, frame) {
  if (!of?.clips[name]) return null;
  const [begin, count] = of.clips[name];
  const at = Math.min(Math.floor(frame + 1e-6) / of.step, count - 1), low = Math.floor(at), high = Math.min(low + 1, count - 1);
  const level = (k, sample) => of.levels[k * of.samples + begin + sample];
  return Float32Array.from({ length: 12 * JOINTS }, (_, k) => (level(k, low) + (at - low) * (level(k, high) - level(k, low))) / 32767 * of.largest);
}

function fixedCamera(view) {
  const [[fx, skew, cx], [, fy, cy]] = view.K;
  return { R: view.R.flat(), t: view.t, fx, fy, cx, cy, skew, width: view.size[0], height: view.size[1] };
}

// Around the middle of the body at rest, y up; from the front at yaw 0.
function freeCamera(avatar, canvas) {
  const side = Math.min(1024, Math.max(256, Math.round(canvas.clientWidth * Math.min(devicePixelRatio, 2)) || 512));
  const focal = side / 2 / Math.tan(FIELD * Math.PI / 360);
  const heights = avatar.joints.map((p) => p[1]);
  const centre = [avatar.joints[0][0], (Math.min(...heights) + Math.max(...heights)) / 2 + 0.03, avatar.joints[0][2]];
  const tall = Math.max(...heights) - Math.min(...heights) + 0.5;
  const distance = 1.15 * tall / 2 / Math.tan(FIELD * Math.PI / 360) / held.zoom;
  const [a, b] = [held.yaw * Math.PI / 180, held.pitch * Math.PI / 180];
  const toward = [Math.sin(a) * Math.cos(b), Math.sin(b), Math.cos(a) * Math.cos(b)];
  const z = toward.map((v) => -v);
  const x = [Math.cos(a), 0, -Math.sin(a)];
  const y = [z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]];
  const R = [...x, ...y, ...z];
  const eye = centre.map((v, k) => v + distance * toward[k]);
  return { R, t: turned(R, eye).map((v) => -v), fx: focal, fy: focal, cx: side / 2, cy: side / 2, skew: 0, width: side, height: side };
}

// Mouse, touch (two fingers come near), wheel and keys.
function steer(canvas, changed) {
  const fingers = new Map();
  const apart = () => {
    const [p, q] = [...fingers.values()];
    return Math.hypot(p.x - q.x, p.y - q.y);
  };
  const turn = (yaw, pitch) => {
    held.yaw = (held.yaw + yaw) % 360;
    held.pitch = Math.max(-85, Math.min(85, held.pitch + pitch));
    changed();
  };
  const near = (by) => { held.zoom = Math.max(0.4, Math.min(8, held.zoom * by)); changed(); };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const finger = fingers.get(event.pointerId);
    if (!finger) return;
    const before = fingers.size === 2 ? apart() : 0;
    const [dx, dy] = [event.clientX - finger.x, event.clientY - finger.y];
    finger.x = event.clientX;
    finger.y = event.clientY;
    if (fingers.size === 2) near(apart() / Math.max(before, 1));
    else turn(-dx * 0.5, dy * 0.4);
  });
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); near(Math.exp(-event.deltaY / 600)); }, { passive: false });
  Object.assign(keys, { ArrowLeft: () => turn(-10, 0), ArrowRight: () => turn(10, 0), ArrowUp: () => turn(0, 5), ArrowDown: () => turn(0, -5),
    "+": () => near(1.15), "=": () => near(1.15), "-": () => near(1 / 1.15) });
}
