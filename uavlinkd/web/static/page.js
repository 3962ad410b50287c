// Shows the server's events. Every name and sentence becomes text, never markup: the policy of the page
// (Trusted Types) forbids the other.
"use strict";

const LOST_MS = 3000; // without an event, or with one that is so late, nothing on the page counts any more
const SHAPES = {
  up: "M8 1a7 7 0 1 0 .01 0z", // disc
  warning: "M8 1 15.5 14.5H.5z", // triangle
  blocked: "M1.5 1.5h13v13h-13z", // square
  waiting: "M8 1a7 7 0 1 0 .01 0zM8 4.500a3.500 3.500 0 1 1-.01 0z", // ring
  lost: "M3 .5 8 5.500 13 .5 15.500 3 10.500 8 15.500 13 13 15.500 8 10.500 3 15.500 .5 13 5.500 8 .5 3z", // cross
  attack: "M5 .5h6L15.500 5v6L11 15.500H5L.5 11V5z", // octagon
  unknown: "M8 .5 15.500 8 8 15.500.5 8z", // diamond
};
const PEERS = ["peer", "state", "silent", "round trip", "loss", "in", "out", "path", "paths"];
const MEMBERS = ["member", "state", "since", "address", "bound", "waiting", "forwarded", "over limit"];
const TABLES = { peers: { order: [1, 1], columns: PEERS }, members: { order: [1, 1], columns: MEMBERS } };
const ORDER = Object.keys(SHAPES).reverse();
const PLOTS = [["round trip", ms], ["loss", percent], ["bytes", rate]];

const peer = location.pathname.startsWith("/peer/") ? decoded(location.pathname.slice(6)) : "";
const at = (id) => document.getElementById(id);
let now = null; // the latest event
let lost = null; // why its facts do not count
let plotted = {};
let heardAt = performance.now();
let source = null; // of the events, while the page is visible
let quickest = Infinity; // difference between this clock and the server's, in the event that travelled fastest

function decoded(text) {
  try { return decodeURIComponent(text); } catch { return text; }
}

// Elements. `attributes` of undefined or false are left out; children are elements, text or null.

function el(tag, attributes, ...children) {
  const is_svg = ["svg", "path", "polyline", "line"].includes(tag);
  const made = is_svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes || {})) {
    if (value !== undefined && value !== false) made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.flat().filter((child) => child !== null).map((child) => (child.nodeType ? child : String(child))));
  return made;
}

// Make `old` like `made`, and leave what is alike: a selection, the focus and the scroll position stay. What a person
// opened or closed stays so too.
function morph(old, made) {
  if (old.nodeName !== made.nodeName || (old.dataset && old.dataset.key !== made.dataset.key)) {
    old.replaceWith(made);
    return;
  }
  if (old.nodeType !== Node.ELEMENT_NODE) {
    if (old.data !== made.data) old.data = made.data;
    return;
  }
  for (const name of old.getAttributeNames()) if (name !== "open" && !made.hasAttribute(name)) old.removeAttribute(name);
  for (const name of made.getAttributeNames()) {
    if (name !== "open" && old.getAttribute(name) !== made.getAttribute(name)) old.setAttribute(name, made.getAttribute(name));
  }
  fill(old, [...made.childNodes]);
}

function fill(parent, children) {
  const keyed = new Map([...parent.children].filter((c) => c.dataset.key).map((c) => [c.dataset.key, c]));
  children.forEach((made, index) => {
    const key = made.dataset && made.dataset.key;
    const same = key && keyed.get(key);
    if (same && parent.childNodes[index] !== same) parent.insertBefore(same, parent.childNodes[index] || null);
    const old = parent.childNodes[index];
    if (old) morph(old, made);
    else parent.append(made);
  });
  while (parent.childNodes.length > children.length) parent.lastChild.remove();
}

// Figures. A line does not break before a unit.

function ms(seconds) { return seconds === null ? "-" : `${(1000 * seconds).toFixed(seconds < 0.01 ? 1 : 0)}\u00a0ms`; }
function percent(share) { return share === null ? "-" : `${(100 * share).toFixed(0)}\u00a0%`; }
function rate(bytes) { return bytes === null ? "-" : bytes < 1000 ? `${Math.round(bytes)}\u00a0B/s` : `${(bytes / 1000).toFixed(1)}\u00a0kB/s`; }
function age(s) { return s === null ? "never" : s < 100 ? `${s.toFixed(s < 10 ? 1 : 0)}\u00a0s` : s < 6000 ? `${Math.round(s / 60)}\u00a0min` : `${Math.round(s / 3600)}\u00a0h`; }
function count(number) { return number.toLocaleString("en"); }
function clock(agoS) {
  const then = new Date(Date.now() - 1000 * agoS), isToday = then.toDateString() === new Date().toDateString();
  return isToday ? then.toLocaleTimeString() : then.toLocaleString();
}

function state(word) {
  const shown = lost === null ? word : "unknown";
  const shape = el("svg", { viewBox: "0 0 16 16", "aria-hidden": "true" }, el("path", { d: SHAPES[shown], "fill-rule": "evenodd" }));
  return el("span", { class: `state ${shown}` }, shape, shown);
}

// Plots: the last ten minutes, a gap where nothing is known.

function plot([name, format], values, index) {
  const known = values.filter((value) => value !== null);
  const most = Math.max(...known, index === 1 ? 0.05 : 1e-9);
  const last = values.length ? values[values.length - 1] : null;
  const runs = [[]];
  values.forEach((value, i) => {
    if (value === null) runs.push([]);
    else runs[runs.length - 1].push(`${(150 - values.length + i).toFixed(0)},${(38 - (36 * value) / most).toFixed(1)}`);
  });
  const said = `${name}, last ten minutes: ${format(last)} now, at most ${format(known.length ? most : null)}`;
  return el("figure", {},
    el("figcaption", {}, name, " ", el("b", {}, lost === null ? format(last) : "-"), ` of ${format(known.length ? most : null)}`),
    el("svg", { viewBox: "0 0 150 40", preserveAspectRatio: "none", role: "img", "aria-label": said },
      el("line", { x1: 0, y1: 38, x2: 150, y2: 38 }),
      runs.filter((run) => run.length).map((run) => el("polyline", { points: run.length > 1 ? run.join(" ") : `${run[0]} ${run[0]}` }))));
}

// Parts of the page.

function problems(lines) {
  return lines.map((line) => el("p", { class: `problem ${line.severity}` },
    el("strong", {}, line.severity), " ", line.who ? el("b", {}, `${line.who}: `) : null, `${line.text}. Remedy: ${line.remedy}.`));
}

function card(facts) {
  const [silent, roundTrip, loss, bytesIn, bytesOut] = facts.figures;
  return el("article", { "data-key": facts.name, class: lost === null ? facts.word : "unknown" },
    el("h2", {}, el("a", { href: `/peer/${encodeURIComponent(facts.name)}` }, facts.name), " ", state(facts.word)),
    el("p", { class: "figures" }, `silent ${age(silent)}, round trip ${ms(roundTrip)}, loss ${percent(loss)}, in ${rate(bytesIn)}, out ${rate(bytesOut)}`),
    el("div", { class: "paths" }, facts.paths.map((path) => onePath(facts.name, path))),
    facts.dropped.length ? el("p", {}, el("b", {}, "dropped: "), facts.dropped.map(([why, times]) => `${count(times)} ${why}`).join(", ")) : null,
    facts.refused.length ? el("details", { "data-key": "refused" }, el("summary", {}, "refused by this daemon's policy"), list(facts.refused, ["direction", "message", "why", "times"])) : null,
    facts.reported.length ? el("details", { "data-key": "reported", open: true }, el("summary", {}, "reported by this peer; a captured one can lie"), el("ul", {}, facts.reported.map((text) => el("li", {}, text)))) : null,
    el("details", { "data-key": "session" }, el("summary", {}, "session"), el("dl", {}, facts.facts.flatMap(([name, text]) => [el("dt", {}, name), el("dd", {}, text)]))));
}

function onePath(name, path) {
  const lines = (plotted[name] || {})[path.number] || [[], [], []];
  const jitter = path.jitter === null ? "" : ` ± ${ms(path.jitter)}`;
  return el("div", { "data-key": String(path.number), class: `path ${lost === null ? path.condition : "unknown"}` },
    el("h3", {}, path.network ? `${path.network} ` : "", el("code", {}, path.address)),
    el("p", {}, el("b", {}, lost === null ? path.state : "unknown"), `, ${path.way}, carries ${path.carries === "-" ? "nothing" : path.carries}`),
    el("p", {}, `round trip ${ms(path.rtt)}${jitter}, loss ${percent(path.loss[0])} in, ${percent(path.loss[1])} out, ${rate(path.rate[0])} in, ${rate(path.rate[1])} out`),
    el("div", { class: "plots" }, PLOTS.map((kind, index) => plot(kind, lines[index], index))));
}

function list(rows, titles) {
  return el("table", {}, el("thead", {}, el("tr", {}, titles.map((title) => el("th", { scope: "col" }, title)))),
    el("tbody", {}, rows.map((row) => el("tr", {}, row.map((cell, index) => el("td", { "data-title": titles[index] }, cell))))));
}

const CELLS = {
  state, silent: age, since: age, "round trip": ms, loss: percent, in: rate, out: rate,
  peer: (name) => el("a", { href: `/peer/${encodeURIComponent(name)}` }, name), path: (text) => text || "-",
};

function table(id, rows) {
  const { order: [column, direction], columns } = TABLES[id];
  const section = at(id), wanted = section.querySelector("input").value.toLowerCase();
  const value = (row) => (columns[column] === "state" ? ORDER.indexOf(row[column]) : row[column]);
  const shown = rows.filter((row) => row.some((cell) => String(cell).toLowerCase().includes(wanted)));
  const unknown = (row) => value(row) === null; // last, in either direction
  shown.sort((a, b) => unknown(a) - unknown(b) || direction * (value(a) < value(b) ? -1 : value(a) > value(b) ? 1 : 0));
  const head = columns.map((title, index) => el("th", { scope: "col", "aria-sort": index !== column ? false : direction > 0 ? "ascending" : "descending" },
    el("button", { type: "button", "data-column": String(index) }, title)));
  const body = shown.map((row) => el("tr", { "data-key": row[0] }, row.map((cell, index) => el("td", {}, (CELLS[columns[index]] || ((is) => (is === null ? "-" : is)))(cell)))));
  section.hidden = !rows.length;
  morph(section.querySelector("table"), el("table", {}, el("thead", {}, el("tr", {}, head)), el("tbody", {}, body)));
}

function rest(facts) {
  const clients = (endpoint) => endpoint.clients.map(([address, silent]) => `${address} (${age(silent)})`).join(", ") || "no client";
  return [
    facts.endpoints.length ? el("h2", {}, "Local endpoints") : null,
    facts.endpoints.length ? list(facts.endpoints.map((e) => [e.name, clients(e), count(e.frames[0]), count(e.frames[1]), e.problems || "-"]), ["endpoint", "clients (silent)", "frames in", "frames out", "problems"]) : null,
    facts.networks.length ? el("h2", {}, "Networks") : null,
    facts.networks.length ? list(facts.networks.map((n) => [n.name, n.exit, n.is_metered ? "metered" : "-", n.text]), ["network", "exit", "metered", "addresses"]) : null,
    ...facts.lines.map((line) => el("p", { class: line.is_good ? false : "warning" }, line.text)),
  ].filter((part) => part !== null);
}

function past(lines) {
  const newest = [...lines].sort((a, b) => (b.ended_s === null) - (a.ended_s === null) || a.began_s - b.began_s);
  const rows = newest.map((line) => [clock(line.began_s), line.ended_s === null ? "lasts" : clock(line.ended_s), line.severity, line.name || "-", `${line.text}. Remedy: ${line.remedy}.`]);
  return newest.length ? [el("h2", {}, "Problems in the log"), list(rows, ["began", "ended", "kind", "of", "what"])] : [];
}

function render() {
  document.body.className = lost === null ? "" : "lost";
  at("back").hidden = !peer;
  if (now === null) {
    at("headline").textContent = lost || "Asking the daemon …";
    return;
  }
  const title = peer || now.daemon;
  document.title = `${title} - uavlinkd`;
  at("title").textContent = title;
  const missing = peer && !now.cards.length ? [el("span", { class: "bad" }, `${now.daemon} has no peer of this name`)] : [];
  const said = [...missing, ...now.headline.map((part) => el("span", { class: part.is_good ? "good" : "bad" }, part.text))];
  fill(at("headline"), lost === null ? said : [el("span", { class: "bad" }, `LOST: ${lost}. What is below was true at ${now.seen}.`)]);
  fill(at("problems"), problems(now.problems));
  fill(at("cards"), now.cards.map(card));
  table("peers", now.rows || []);
  table("members", now.members || []);
  fill(at("rest"), peer ? [] : rest(now));
  fill(at("past"), past(now.past));
}

// Events.

function lose(why) {
  if (lost === why) return;
  lost = why;
  render();
}

function listen() {
  if (document.hidden) return;
  source = new EventSource(`/events?peer=${encodeURIComponent(peer)}`);
  source.addEventListener("open", () => { quickest = Infinity; }); // after a reboot the server's clock begins again
  source.addEventListener("now", (event) => {
    const facts = JSON.parse(event.data);
    const late = performance.now() - 1000 * facts.at;
    quickest = Math.min(quickest + 1, late); // the two clocks may drift by 1 ms an event
    if (late - quickest > LOST_MS) return; // it waited in a buffer
    heardAt = performance.now();
    if (facts.lost !== undefined) {
      lose(facts.lost);
      return;
    }
    now = { ...facts, seen: new Date().toLocaleTimeString() };
    lost = null;
    render();
  });
  source.addEventListener("history", (event) => { plotted = JSON.parse(event.data); });
  source.addEventListener("sample", (event) => {
    for (const [name, paths] of Object.entries(JSON.parse(event.data))) {
      for (const [number, lines] of Object.entries(paths)) {
        const kept = ((plotted[name] ??= {})[number] ??= [[], [], []]);
        lines.forEach((points, index) => { kept[index] = [...kept[index], ...points].slice(-150); });
      }
    }
  });
  source.addEventListener("error", ({ target }) => {
    if (target === source && target.readyState === EventSource.CLOSED) setTimeout(listen, 2000); // refused: the browser gives up
  });
}

for (const id of Object.keys(TABLES)) {
  const section = at(id), shown = () => now && table(id, now[id === "peers" ? "rows" : "members"] || []);
  section.addEventListener("input", shown);
  section.addEventListener("click", (event) => {
    const column = Number(event.target.dataset.column), order = TABLES[id].order;
    if (Number.isNaN(column)) return;
    TABLES[id].order = [column, order[0] === column ? -order[1] : 1];
    shown();
  });
}
document.addEventListener("visibilitychange", () => { // a browser has six connections to a server, for all its tabs
  source?.close();
  heardAt = performance.now();
  listen();
});
setInterval(() => {
  if (!document.hidden && performance.now() - heardAt > LOST_MS) lose("the page's server does not answer");
}, 500);
listen();
