// Making elements and text. Nothing here reads text as HTML: names come from anybody's run folders.

const SVG = "http://www.w3.org/2000/svg";

// An element with properties and children. `on…` are listeners, `data-…`, `aria-…` and the like are attributes.
function el(tag, props = {}, ...children) {
  return filled(document.createElement(tag), props, children);
}

function svg(tag, props = {}, ...children) {
  return filled(document.createElementNS(SVG, tag), props, children);
}

function filled(node, props, children) {
  for (const [name, value] of Object.entries(props)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (name === "value" || name === "checked" || name === "selected") node[name] = value;
    else node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.flat(9).filter((child) => child !== null && child !== undefined && child !== false));
  return node;
}

function button(text, onclick, props = {}) {
  return el("button", { type: "button", onclick, ...props }, text);
}

// A labelled choice; `options` are [value, text].
function choice(label, options, value, onchange, props = {}) {
  const select = el("select", { onchange: (event) => onchange(event.target.value), ...props },
    options.map(([v, text]) => el("option", { value: String(v), selected: String(v) === String(value) }, text)));
  return el("label", { class: "choice" }, el("span", {}, label), select);
}

function toggle(text, on, change, props = {}) {
  return button(text, () => change(!on), { class: "chip", "aria-pressed": String(on), ...props });
}

// --- numbers ---

function metricOf(identity) {
  return DATA.metrics[identity.split("/")[0]];
}

// "psnr/pooled/range1/hidden/v1" or ".../hidden/bg0,0,0/v1" -> "hidden"
function regionOf(identity) {
  return identity.split("/").find((part) => REGION.test(part)) ?? identity.split("/").at(-2);
}

const REGION = /^(full|body|visible|hidden|never_seen|box(\+[0-9.]+)?)$/;

// A stored value as a number: "inf", null and [reason] are not finite.
function real(value) {
  if (typeof value === "number") return value;
  if (value === "inf") return Infinity;
  if (value === "-inf") return -Infinity;
  return NaN;
}

// As the report's tables show it.
function shown(value, metric) {
  const v = real(value);
  if (Number.isNaN(v)) return "—";
  if (!Number.isFinite(v)) return v > 0 ? "∞" : "−∞";
  return fixed(v * metric.scale, metric.decimals);
}

// `toFixed` that rounds as Python's format does: by the exact value of the double.
function fixed(value, decimals) {
  const longer = value.toFixed(decimals + 1);
  if (Number(longer) !== value || !longer.endsWith("5")) return value.toFixed(decimals);
  const cut = decimals ? longer.slice(0, -1) : longer.slice(0, -2); // a tie: to the even digit
  return Number(cut.at(-1)) % 2 ? value.toFixed(decimals) : cut;
}

function seconds(value) {
  if (value === null || value === undefined) return "—";
  return value < 10 ? value.toFixed(1) : value.toFixed(0);
}

function titled(identity) {
  const metric = metricOf(identity);
  const variant = DATA.variants[identity]; // of metrics called alike
  return `${metric.title} ${regionOf(identity).replace("_", " ")} ${variant ? `${variant} ` : ""}${metric.arrow}`;
}

// --- pictures and other files of the site: beside the page, or inside it ---

const urls = new Map();

function fileText(name) {
  return document.getElementById(`file-${name}`)?.textContent.trim() ?? null;
}

function pictureUrl(name) {
  if (!urls.has(name)) {
    const text = fileText(name);
    const kind = name.endsWith(".png") ? "image/png" : "image/webp";
    urls.set(name, text === null ? `files/${name}` : `data:${kind};base64,${text}`);
  }
  return urls.get(name);
}

function picture(name, alt, props = {}) {
  return el("img", { src: pictureUrl(name), alt, draggable: "false", ...props });
}

function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

// --- the address: #tab?name=value&… ---

function address() {
  const [tab, query = ""] = location.hash.slice(1).split("?");
  return { tab: tab || "leaderboard", of: new URLSearchParams(query) };
}

function link(tab, values = {}) {
  const query = new URLSearchParams(Object.entries(values).filter(([, v]) => v !== undefined && v !== null));
  return `#${tab}${query.size ? `?${query}` : ""}`;
}

function go(tab, values = {}) {
  location.hash = link(tab, values);
}

// The same tab with some values changed, without a new entry in the browser's history.
function put(values) {
  const { tab, of } = address();
  const all = { ...Object.fromEntries(of), ...values };
  history.replaceState(null, "", link(tab, all));
  show();
}

function copied(text, node) {
  const said = (words) => {
    const before = node.textContent;
    node.textContent = words;
    setTimeout(() => { node.textContent = before; }, 1200);
  };
  if (!navigator.clipboard) return said("not allowed here");
  navigator.clipboard.writeText(text).then(() => said("copied"), () => said("not allowed here"));
}

const COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8c8c8c", "#7b5cd6", "#a6761d", "#e7298a",
  "#66a61e", "#1aa0a0"]; // Okabe and Ito's, then as many as there are systems

function colourOf(k) {
  return COLOURS[k % COLOURS.length];
}
