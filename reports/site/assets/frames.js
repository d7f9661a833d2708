// The scenes at a glance, and one test view: input, truth, predictions, errors, regions, and its own scores.

const OVERLAYS = { visible: "visible", hidden: "hidden", never_seen: "never seen", box: "box" };
const overlays = new Set();
let split = 0.5;

function scenesTab(group, g) {
  const scenes = DATA.frames.filter((s) => s.group === g);
  if (!scenes.length) return el("p", {}, "No pictures: no run of this group has left any.");
  return scenes.map((scene) => {
    const views = scene.views.slice(0, 12);
    return el("section", { class: "scene" }, el("h3", {}, scene.scene),
      scene.reason && el("p", { class: "note" }, `Without truth and regions: ${scene.reason}`),
      scene.runs.map((k) => {
        const run = DATA.runs[k];
        return el("div", {}, el("h4", {}, `${run.label}, seed ${run.seed} `, headlineScore(run)),
          el("div", { class: "thumbs" }, views.filter((v) => v.predictions[k]).map((v) => el("a", {
            href: link("frame", { group: g, scene: scene.scene, camera: v.camera, frame: v.frame, a: k }),
            title: `${v.camera}/${v.frame}; the truth while the pointer or the focus is on it`,
          }, cropped(v, el("div", { class: "layer" },
            picture(v.predictions[k], `prediction of ${v.camera}/${v.frame}`, { loading: "lazy" }),
            v.truth && picture(v.truth, `truth of ${v.camera}/${v.frame}`, { loading: "lazy", class: "over" })))))));
      }));
  });
}

function headlineScore(run) {
  const k = run.identities.findIndex((i) => regionOf(i) === run.headline);
  return k >= 0 && el("small", {}, `${titled(run.identities[k])} ${shown(run.means[k], metricOf(run.identities[k]))}`);
}

function frameTab(group, g, of) {
  const scenes = DATA.frames.filter((s) => s.group === g);
  const scene = scenes.find((s) => s.scene === of.get("scene")) ?? scenes[0];
  if (!scene) return el("p", {}, "No run of this group is done.");
  const a = scene.runs.includes(Number(of.get("a") ?? NaN)) ? Number(of.get("a")) : scene.runs[0];
  const b = scene.runs.includes(Number(of.get("b") || NaN)) ? Number(of.get("b")) : null;
  const run = DATA.runs[a];
  if (!scene.views.length && !run.views.length) return el("p", {}, "There is no test view here, neither pictures nor scores.");
  const key = (v) => `${v.camera}/${v.frame}`;
  const wanted = of.get("camera") === null ? key(scene.views[0] ?? run.views[0]) : `${of.get("camera")}/${of.get("frame")}`;
  const view = scene.views.find((v) => key(v) === wanted);
  const scored = run.views.find((v) => key(v) === wanted) ?? null;
  const pictured = scene.views.filter((v) => v.predictions[a]);
  const order = of.get("by") && run.identities.includes(of.get("by")) ? of.get("by") : hardest(run);
  const names = scene.runs.map((k) => [k, `${DATA.runs[k].label}, seed ${DATA.runs[k].seed}`]);
  const to = (v) => v && put({ camera: v.camera, frame: v.frame });
  const here = pictured.findIndex((v) => key(v) === wanted);
  const step = (n) => to(pictured[(here + n + pictured.length) % pictured.length]);
  keys.ArrowLeft = () => step(-1);
  keys.ArrowRight = () => step(1);
  keys.w = () => to(worse(run, pictured, order, wanted));
  return [
    el("div", { class: "bar" },
      choice("scene", scenes.map((s) => [s.scene, s.scene]), scene.scene,
        (v) => go("frame", { group: g, scene: v })),
      choice("method", names, a, (v) => put({ a: v })),
      choice("beside", [["", "nothing"], ...names], b ?? "", (v) => put({ b: v })),
      choice("test view", run.views.map((v) => [key(v), key(v) + (pictured.some((p) => key(p) === key(v)) ? "" : " (numbers)")]),
        wanted, (v) => { const [camera, frame] = cut(v); put({ camera, frame }); })),
    el("div", { class: "bar" },
      button("← previous", keys.ArrowLeft, { title: "key: left" }), button("next →", keys.ArrowRight, { title: "key: right" }),
      button("next worst (w)", keys.w, { "data-action": "worst" }),
      choice("by", run.identities.map((i) => [i, titled(i)]), order, (v) => put({ by: v }))),
    view ? stage(scene, view, a, b) : el("p", { class: "note" },
      `No pictures of ${wanted} in this site (ihbench site --views N takes more); its numbers are below.`),
    view && panes(scene, view, b === null ? [a] : [a, b]),
    view && scene.reason && el("p", { class: "note" }, `Without truth and regions: ${scene.reason}`),
    scored && scoreTable(scored, wanted, b === null ? [a] : [a, b]),
  ];
}

function cut(text) {
  const at = text.lastIndexOf("/");
  return [text.slice(0, at), text.slice(at + 1)];
}

// The identity by which views are bad: the first metric of what was hidden, else of the headline.
function hardest(run) {
  return run.identities.find((i) => regionOf(i) === "hidden") ?? run.identities.find((i) => regionOf(i) === run.headline)
    ?? run.identities[0];
}

// The view that follows this one in the order from worst to best; the worst where this one has no place in it.
function worse(run, pictured, identity, wanted) {
  const place = run.identities.indexOf(identity);
  const sign = metricOf(identity).higher ? 1 : -1;
  const value = new Map(run.views.map((v) => [`${v.camera}/${v.frame}`, real(v.scores[place])]));
  const known = pictured.filter((v) => !Number.isNaN(value.get(`${v.camera}/${v.frame}`) ?? NaN));
  known.sort((x, y) => sign * (value.get(`${x.camera}/${x.frame}`) - value.get(`${y.camera}/${y.frame}`)));
  const now = known.findIndex((v) => `${v.camera}/${v.frame}` === wanted);
  const last = worse.last === `${run.name} ${identity}`;
  worse.last = `${run.name} ${identity}`;
  return known[last && now >= 0 ? (now + 1) % known.length : 0];
}

// [name, what it shows] of every layer of a view.
function layers(scene, view) {
  const found = [];
  if (view.input) found.push(["input", "training input"]);
  if (view.truth) found.push(["truth", "truth"]);
  for (const k of scene.runs) {
    const who = `${DATA.runs[k].label}, seed ${DATA.runs[k].seed}`;
    if (view.predictions[k]) found.push([`p${k}`, who]);
    if (view.predictions[k] && view.truth) found.push([`e${k}`, `error ×4 of ${who}`]);
  }
  return found;
}

// One layer as an element: a picture, or the difference of two, four times as strong, by the browser's own blending.
function layer(name, view) {
  const k = name.slice(1);
  if (name === "input") {
    return el("div", { class: "layer" }, picture(view.input, `training input, frame ${view.input_frame}`),
      view.masks.occluded && picture(view.masks.occluded, "occluded pixels", { class: "solid" }));
  }
  if (name === "truth") return el("div", { class: "layer" }, picture(view.truth, "truth"), hiddenParts(view), marked(view));
  if (name[0] === "p") return el("div", { class: "layer" }, picture(view.predictions[k], "prediction"), marked(view));
  return el("div", { class: "layer" }, el("div", { class: "error" }, picture(view.truth, "error"),
    picture(view.predictions[k], "", { class: "minus" })), hiddenParts(view), marked(view));
}

// Only the window of a view in which the person is, or all of it.
let whole = false;

function cropped(view, ...inner) {
  const [width, height] = view.size;
  const [left, top, right, bottom] = whole || !view.window ? [0, 0, width, height] : view.window;
  const part = el("div", { class: "part" }, inner);
  const box = el("div", { class: "crop" }, part);
  box.style.aspectRatio = `${right - left} / ${bottom - top}`;
  part.style.width = `${100 * width / (right - left)}%`;
  part.style.left = `${-100 * left / (right - left)}%`;
  part.style.top = `${-100 * top / (bottom - top)}%`;
  return box;
}

// Where nobody knows the truth there is none, and no error.
function hiddenParts(view) {
  return view.masks.unknown && picture(view.masks.unknown, "truth unknown here", { class: "solid" });
}

function marked(view) {
  return [...overlays].filter((name) => view.masks[name])
    .map((name) => picture(view.masks[name], `region ${name}`, { class: "mask", "data-region": name }));
}

function stage(scene, view, a, b) {
  const names = layers(scene, view);
  const { of } = address();
  const has = (name) => names.some(([n]) => n === name);
  const left = has(of.get("left")) ? of.get("left") : has("truth") ? "truth" : `p${a}`;
  const right = has(of.get("right")) ? of.get("right") : b !== null ? `p${b}` : `p${a}`;
  const top = el("div", { class: "clip" }, cropped(view, layer(left, view)));
  const handle = el("div", { class: "handle" });
  const move = (share) => {
    split = Math.min(1, Math.max(0, share));
    top.style.clipPath = `inset(0 ${100 - 100 * split}% 0 0)`;
    handle.style.left = `${100 * split}%`;
  };
  const slider = el("input", { type: "range", min: "0", max: "1000", value: String(Math.round(1000 * split)),
    "aria-label": "split between left and right", oninput: (event) => move(event.target.value / 1000) });
  const box = el("div", { class: "stage" }, cropped(view, layer(right, view)), top, handle);
  const drag = (event) => {
    if (event.type === "pointermove" && !event.buttons) return;
    const at = box.getBoundingClientRect();
    move((event.clientX - at.left) / at.width);
    slider.value = Math.round(1000 * split);
  };
  box.addEventListener("pointerdown", (event) => { box.setPointerCapture(event.pointerId); drag(event); });
  box.addEventListener("pointermove", drag);
  move(split);
  return el("div", { class: "compare" },
    el("div", { class: "bar" },
      choice("left", names, left, (v) => put({ left: v })), choice("right", names, right, (v) => put({ right: v })),
      el("div", { class: "chips", role: "group", "aria-label": "regions" }, Object.entries(OVERLAYS)
        .filter(([name]) => scene.views.some((v) => v.masks[name]))
        .map(([name, words]) => toggle(words, overlays.has(name), (on) => {
          on ? overlays.add(name) : overlays.delete(name);
          show();
        }, { class: `chip ${name}` })),
        toggle("whole picture", whole, (on) => { whole = on; show(); }))),
    box, slider);
}

function panes(scene, view, runs) {
  const figure = (name, words) => el("figure", {}, cropped(view, layer(name, view)), el("figcaption", {}, words));
  return runs.map((k) => el("div", { class: "panes" },
    view.input && figure("input", `training input, frame ${view.input_frame}`),
    view.truth && figure("truth", "truth"),
    view.predictions[k] && figure(`p${k}`, DATA.runs[k].label),
    view.predictions[k] && view.truth && figure(`e${k}`, "error ×4")));
}

function scoreTable(scored, wanted, runs) {
  const of = (k, identity) => {
    const run = DATA.runs[k];
    const view = run.views.find((v) => `${v.camera}/${v.frame}` === wanted);
    return view?.scores[run.identities.indexOf(identity)];
  };
  const first = DATA.runs[runs[0]];
  const metrics = [...new Set(first.identities.map((i) => i.split("/")[0]))];
  const regions = [...new Set(first.identities.map(regionOf))];
  const cell = (k, identity) => {
    const value = identity && of(k, identity);
    const reason = Array.isArray(value) ? DATA.runs[k].reasons[value[0]] : null;
    return el("td", { title: identity ? `${identity} = ${reason ?? value}` : "", "data-identity": identity,
      "data-value": value === undefined ? null : String(value) }, identity ? shown(value, metricOf(identity)) : "");
  };
  const find = (metric, region) => first.identities.find((i) => i.split("/")[0] === metric && regionOf(i) === region);
  return el("section", {}, el("h3", {}, `Scores of ${wanted}`), el("div", { class: "wide" }, el("table", { class: "scores" },
    el("thead", {}, el("tr", {}, el("th", { scope: "col" }, ""), runs.map((k) => metrics.map((m) =>
      el("th", { scope: "col" }, `${DATA.metrics[m].title} ${DATA.metrics[m].arrow}`,
        runs.length > 1 && el("small", {}, ` ${DATA.runs[k].label}`)))))),
    el("tbody", {}, regions.map((region) => el("tr", { class: region === first.headline ? "headline" : "" },
      el("th", { scope: "row" }, region), runs.map((k) => metrics.map((m) => cell(k, find(m, region))))))))),
  absences(scored, first));
}

function absences(scored, run) {
  const why = [...new Set(scored.scores.filter(Array.isArray).map(([k]) => run.reasons[k]))];
  return why.length > 0 && el("ul", { class: "note" }, why.map((reason) => el("li", {}, `—: ${reason}`)));
}
