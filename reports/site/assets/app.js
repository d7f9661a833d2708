// Which screen is shown, for which group of runs.

const TABS = {
  leaderboard: ["Leaderboard", leaderboardTab],
  scenes: ["Scenes", scenesTab],
  frame: ["Frame", frameTab],
  curves: ["Curves", curvesTab],
  avatar: ["Avatar", avatarTab],
  about: ["About", aboutTab],
};
const PICTURED = ["scenes", "frame", "avatar"]; // need files, which a single file has below the script
let keys = {}; // of the screen that is shown: key -> what it does
let shownGroup = null;
let leaving = null; // what the screen that is shown has to end

function show() {
  const { tab, of } = address();
  const name = tab in TABS ? tab : "leaderboard";
  const g = Math.min(Math.max(0, Number(of.get("group")) || 0), DATA.groups.length - 1);
  const group = DATA.groups[g];
  if (g !== shownGroup) Object.assign(board, { metrics: null, regions: null, sort: null, open: null });
  shownGroup = g;
  const focus = focusPath();
  keys = {};
  leaving?.();
  leaving = null;
  const words = (one) => `${one.protocol}, ${one.profile}, ${one.standin || "real data"}`;
  document.getElementById("groups").replaceChildren(
    DATA.groups.length > 1 ? choice("runs under", DATA.groups.map((one, k) => [k, words(one)]), g,
      (v) => go(name, { group: v })) : el("span", {}, group ? words(group) : ""),
    group?.standin ? el("b", { class: "badge", title: group.data }, "stand-in data") : "");
  document.getElementById("tabs").replaceChildren(...Object.entries(TABS).map(([key, [title]]) =>
    el("a", { href: link(key, { group: g }), "aria-current": key === name ? "page" : null }, title)));
  const main = document.getElementById("main");
  const early = PICTURED.includes(name) && document.readyState === "loading";
  if (early) document.addEventListener("DOMContentLoaded", show, { once: true });
  main.dataset.tab = name;
  main.replaceChildren(...[early ? el("p", { class: "note" }, "Reading the pictures.") : group ? TABS[name][1](group, g, of) : el("p", {}, "There is no run here.")].flat(9).filter(Boolean));
  restoreFocus(focus);
}

// A screen is made anew when something is chosen on it: the focus goes to the same place.
function focusPath() {
  const path = [];
  for (let node = document.activeElement; node && node.id !== "main"; node = node.parentElement) {
    if (!node.parentElement) return null;
    path.unshift([...node.parentElement.children].indexOf(node));
  }
  return path.length ? path : null;
}

function restoreFocus(path) {
  if (!path) return;
  let node = document.getElementById("main");
  for (const k of path) node = node?.children[k];
  node?.focus?.({ preventScroll: true });
}

document.addEventListener("keydown", (event) => {
  if (event.altKey || event.ctrlKey || event.metaKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName)) return;
  if (event.key === " " && /^(BUTTON|A|SUMMARY)$/.test(event.target.tagName)) return; // presses it
  if (keys[event.key]) {
    event.preventDefault();
    keys[event.key]();
  }
});

const THEMES = ["auto", "dark", "light"];
document.getElementById("theme").addEventListener("click", (event) => {
  const now = document.documentElement.dataset.theme ?? "auto";
  const next = THEMES[(THEMES.indexOf(now) + 1) % THEMES.length];
  document.documentElement.dataset.theme = next;
  event.target.textContent = `theme: ${next}`;
});
addEventListener("hashchange", show);
show();
follow();
