// Shows the server's events. Every name and sentence becomes text, never markup: the policy of the page
// (Trusted Types) forbids the other.
"use strict";

const LOST_MS = 3000; // without an event, or with one that is so late, nothing on the page counts any more
const COPIED_MS = 3000; // how long a button says that it copied
const SILENT_S = 5; // without a heartbeat: autopilots send one each second
const SAMPLE_S = 4; // between two points of a plot
const SAMPLES = 150; // of ten minutes
const SHAPES = {
  up: "M8 1a7 7 0 1 0 .01 0z", // disc
  warning: "M8 1 15.5 14.5H.5z", // triangle
  waiting: "M8 1a7 7 0 1 0 .01 0zM8 4.500a3.500 3.500 0 1 1-.01 0z", // ring
  blocked: "M1.5 1.5h13v13h-13z", // square
  lost: "M3 .5 8 5.500 13 .5 15.500 3 10.500 8 15.500 13 13 15.500 8 10.500 3 15.500 .5 13 5.500 8 .5 3z", // cross
  attack: "M5 .5h6L15.500 5v6L11 15.500H5L.5 11V5z", // octagon
  unknown: "M8 .5 15.500 8 8 15.500.5 8z", // diamond
};
const SEVERITIES = { security: "attack", fault: "blocked", warning: "warning" };
const PEERS = ["vehicle", "state", "flight", "battery", "commands pass", "path", "round trip", "loss", "in", "out"];
const MEMBERS = ["member", "state", "since", "address", "bound", "waiting", "forwarded", "over limit"];
const TABLES = { peers: { order: [1, 1], columns: PEERS }, members: { order: [1, 1], columns: MEMBERS } };
const ORDER = Object.keys(SHAPES).reverse();

const peer = location.pathname.startsWith("/peer/") ? decoded(location.pathname.slice(6)) : "";
const at = (id) => document.getElementById(id);
let now = null; // the latest event
let lost = null; // why its facts do not count
let plotted = {};
let copied = ""; // what a button copied just now
let heardAt = performance.now();
let source = null; // of the events, while the page is visible
let quickest = Infinity; // difference between this clock and the server's, in the event that travelled fastest

function decoded(text) {
  try { return decodeURIComponent(text); } catch { return text; }
}

// Elements. `attributes` of undefined or false are left out; children are elements, text or null.

function el(tag, attributes, ...children) {
  const is_svg = ["svg", "path", "polyline", "line", "rect"].includes(tag);
  const made = is_svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes || {})) {
    if (value !== undefined && value !== false) made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.flat(2).filter((child) => child !== null).map((child) => (child.nodeType ? child : String(child))));
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
function rate(bytes) {
  if (bytes === null) return "-";
  return bytes < 1000 ? `${Math.round(bytes)}\u00a0B/s` : `${(bytes / 1000).toFixed(1)}\u00a0kB/s`;
}
function age(s) {
  if (s === null) return "never";
  if (s < 100) return `${s.toFixed(s < 10 ? 1 : 0)}\u00a0s`;
  return s < 6000 ? `${Math.round(s / 60)}\u00a0min` : `${Math.round(s / 3600)}\u00a0h`;
}
function charge(whole) { return whole === null ? "-" : `${whole}\u00a0%`; }
function count(number) { return number.toLocaleString("en"); }
function clock(agoS) {
  const then = new Date(Date.now() - 1000 * agoS), isToday = then.toDateString() === new Date().toDateString();
  return isToday ? then.toLocaleTimeString() : then.toLocaleString();
}

function state(word, text = word) {
  const shown = lost === null ? word : "unknown";
  const shape = el("svg", { viewBox: "0 0 16 16", "aria-hidden": "true" }, el("path", { d: SHAPES[shown], "fill-rule": "evenodd" }));
  return el("span", { class: `state ${shown}` }, shape, lost === null ? text : shown);
}

// Plots: the last ten minutes. Nothing is drawn where nothing is known; an outage is a band.

function runs(values, wanted) {
  const found = [];
  values.forEach((value, i) => {
    if (!wanted(value, i)) return;
    const last = found[found.length - 1];
    if (last && last[1] === i) last[1] = i + 1;
    else found.push([i, i + 1]);
  });
  return found;
}

function plot(name, format, lines, index) {
  const values = lines[index], known = values.filter((value) => value !== null);
  const most = Math.max(...known, index === 1 ? 0.05 : 1e-9), left = SAMPLES - values.length;
  const outages = index === 2 ? [] : runs(values, (_, i) => lines[1][i] === null && lines[2][i] !== null);
  const downS = SAMPLE_S * outages.reduce((sum, [from, to]) => sum + to - from, 0);
  const latest = format(values.length ? values[values.length - 1] : null);
  const down = outages.length ? `; ${outages.length} ${outages.length > 1 ? "outages" : "outage"}, ${age(downS)} together` : "";
  const at = (value, i) => `${left + i},${(31 - (24 * value) / most).toFixed(1)}`;
  const line = (points) => el("polyline", { points: points.length > 1 ? points.join(" ") : `${points[0]} ${points[0]}` });
  return [
    `${latest} now, at most ${format(known.length ? most : null)}`,
    el("svg", { viewBox: `0 0 ${SAMPLES} 32`, preserveAspectRatio: "none", role: "img",
      "aria-label": `${name}, last ten minutes: ${latest} now, at most ${format(known.length ? most : null)}${down}` },
      [0, 37.5, 75, 112.5, 150].map((x) => el("line", { x1: x, y1: 0, x2: x, y2: 32 })),
      outages.map(([from, to]) => el("rect", { x: left + from - 0.5, y: 0, width: to - from, height: 32 })),
      runs(values, (value) => value !== null).map(([from, to]) => line(values.slice(from, to).map((value, i) => at(value, from + i))))),
  ];
}

function axis() {
  return el("div", { class: "axis", "aria-hidden": "true" }, ["10 min", "5 min", "now"].map((text) => el("span", {}, text)));
}

// The plots of a peer's best path at each moment.
function together(paths) {
  const all = Object.values(paths || {});
  if (!all.length) return null;
  const length = Math.max(...all.map((lines) => lines[0].length));
  const least = (kind, i) => {
    const known = all.map((lines) => lines[kind][lines[kind].length - length + i] ?? null).filter((value) => value !== null);
    return known.length ? Math.min(...known) : null;
  };
  return [0, 1, 2].map((kind) => Array.from({ length }, (_, i) => least(kind, i)));
}

// Problems: a cause, and what to do about it.

function quoted(text) { // what is between backticks is for a terminal or a file
  return text.split("`").map((part, i, all) => (i % 2 && i < all.length - 1 ? el("code", {}, part) : part));
}

function commands(text) { // that run here; a name with other signs could be more than it seems to be
  return text.split("`").filter((part, i, all) => i % 2 && /^[ -~]+ [ -~]+$/.test(part) && /^ here\b/.test(all[i + 1]));
}

function copier(command) {
  const said = el("span", {}, copied === command ? "Copied" : "Copy");
  return el("button", { type: "button", class: "copy", "data-copy": command }, said, el("code", {}, command));
}

function problems(lines) {
  if (!lines.length) return [];
  const one = (line) => el("li", { class: `problem ${line.severity}` },
    el("p", { class: "who" }, state(SEVERITIES[line.severity], line.severity), line.who ? el("b", {}, line.who) : null),
    el("p", { class: "cause" }, quoted(`${line.text}.`)),
    el("p", { class: "remedy" }, el("b", {}, "Remedy: "), quoted(`${line.remedy}.`)),
    navigator.clipboard ? commands(line.remedy).map(copier) : null);
  return [el("h2", {}, lines.length > 1 ? `${lines.length} problems` : "1 problem"), el("ul", {}, lines.map(one))];
}

// Peers.

function link(name) { return el("a", { href: `/peer/${encodeURIComponent(name)}` }, name); }

// What a pilot asks: each answer is a title, a value, what more there is to say, and whether it is good, bad or neither.

function flight({ vehicles: [vehicle, ...others], role, is_up }) {
  if (vehicle === undefined) return role === "vehicle" && is_up ? ["Vehicle", "no heartbeat", "", ""] : null;
  const armed = vehicle.is_armed ? "armed" : "disarmed", more = others.length ? ` and ${others.length} more` : "";
  if (vehicle.heartbeat_s > SILENT_S) return ["Vehicle", `was ${armed}`, `${vehicle.mode}, ${age(vehicle.heartbeat_s)} ago`, ""];
  return ["Vehicle", armed, vehicle.mode + more, armed];
}

function battery({ vehicles: [vehicle] }) {
  const { battery_percent: whole = null, battery_v: volts = null } = vehicle || {};
  const known = [...(whole === null ? [] : [charge(whole)]), ...(volts === null ? [] : [`${volts.toFixed(1)}\u00a0V`])];
  return known.length ? ["Battery", known[0], known[1] || "", ""] : null;
}

function commanded(facts) {
  if (!facts.commands.in && !facts.commands.out) return null;
  const title = facts.commands.out ? "Commands pass" : "Its commands pass", unanswered = facts.freshness_unverified_s;
  if (lost !== null) return [title, "unknown", "", ""];
  if (!facts.is_up) return [title, "no", "the link is down", "bad"];
  if (facts.word === "blocked") return [title, "no", "see the problem", "bad"];
  if (unanswered !== null) return [title, "no", `no answer for ${age(unanswered)}`, "bad"];
  return [title, "yes", `${age(facts.answered_s ?? facts.last_received_s)} old`, "good"];
}

function cell([title, value, more, tone]) {
  const tones = (lost === null ? tone : "old") || false;
  return el("div", { class: tones }, el("dt", {}, title), el("dd", {}, el("b", {}, value), more ? ` ${more}` : null));
}

function row(facts) {
  const said = (answer, between) => (answer === null ? "" : answer.slice(1, 3).filter((part) => part).join(between));
  const flying = facts.last_received_s === null ? "never seen" : said(flight(facts), " ");
  const asked = [flying, battery(facts)?.[1] ?? "", said(commanded(facts), ", ")];
  return [facts.name, facts.word, ...asked, facts.path, facts.round_trip_s, facts.loss, ...facts.rates];
}

function member([name, is]) {
  const state = is.is_up ? "up" : "lost", addresses = [...new Set(is.addresses)].join(", ");
  return [name, state, is.since_s, addresses, is.bound, is.waiting, is.datagrams, is.over_limit];
}

function card(facts) {
  facts.paths.sort((a, b) => a.number - b.number); // however often the best one changes
  const cells = [flight(facts), battery(facts), commanded(facts)].filter((answer) => answer !== null).map(cell);
  const seen = facts.last_received_s === null ? "never seen here" : `seen ${age(facts.last_received_s)} ago`;
  return el("article", { "data-key": facts.name, class: lost === null ? facts.word : "unknown" },
    el("header", {}, el("h2", {}, link(facts.name)), state(facts.word), facts.word === "up" ? null : el("span", { class: "seen" }, seen)),
    cells.length ? el("dl", { class: "cells" }, cells) : null,
    facts.paths.length ? paths(facts) : null,
    facts.facts.length ? details(facts) : null);
}

function paths(facts) {
  const titles = ["path", "round trip", "loss", "last ten minutes"];
  const one = (path) => {
    const loss = path.loss[0] === null ? null : Math.max(...path.loss);
    const [, drawing] = plot(`round trip, ${path.kind}`, ms, linesOf(facts.name, path), 0);
    return el("tr", { "data-key": String(path.number), class: `path ${lost === null ? path.condition : "unknown"}` },
      el("th", { scope: "row" }, el("b", {}, path.kind), " ", el("small", {}, lost === null ? path.state : "unknown")),
      el("td", {}, lost === null ? ms(path.rtt) : "-"), el("td", {}, lost === null ? percent(loss) : "-"), el("td", {}, drawing));
  };
  return el("table", { class: "paths", "aria-label": `paths to ${facts.name}` },
    el("thead", {}, el("tr", {}, titles.map((title) => el("th", { scope: "col" }, title)))),
    el("tbody", {}, facts.paths.map(one)),
    el("tfoot", { "aria-hidden": "true" }, el("tr", {}, el("td", { colspan: 3 }), el("td", {}, axis()))));
}

function linesOf(name, path) { return (plotted[name] || {})[path.number] || [[], [], []]; }

function details({ name, paths, facts, dropped, refused, reported }) {
  return el("details", { "data-key": "details", open: Boolean(peer) }, el("summary", {}, "Details"),
    paths.map((path) => onePath(name, path)),
    part("Dropped", dropped, () => el("ul", {}, dropped.map(([why, times]) => el("li", {}, `${count(times)} ${why}`)))),
    part("Refused by this daemon's policy", refused, () => list(refused, ["direction", "message", "why", "times"])),
    part("Reported by this peer; a captured one can lie", reported,
      () => el("ul", {}, reported.map((claim) => el("li", {}, claimed(claim))))),
    el("h3", {}, "Session"), el("dl", { class: "facts" }, facts.map(([fact, text]) => [el("dt", {}, fact), el("dd", {}, text)])));
}

function part(title, rows, content) { return rows.length ? [el("h3", {}, title), content()] : null; }

function claimed({ message, command, count: times, reason }) {
  return `it refused ${[message, command].filter((name) => name).join(" ")} ${count(times)} times: ${reason.replaceAll("_", " ")}`;
}

function onePath(name, path) {
  const jitter = path.jitter === null ? "" : ` ± ${ms(path.jitter)}`;
  const both = (title, format, [into, out]) => `${title} ${format(into)} in, ${format(out)} out`;
  const figure = (title, format, index) => {
    const [said, drawing] = plot(`${title}, ${path.kind}`, format, linesOf(name, path), index);
    return el("figure", {}, el("figcaption", {}, el("b", {}, title), ` ${said}`), drawing, axis());
  };
  return el("section", { "data-key": `path ${path.number}`, class: "one" },
    el("h3", {}, `${path.kind} `, el("code", {}, path.address)),
    el("p", {}, `${lost === null ? path.state : "unknown"}, carries ${path.carries === "-" ? "nothing" : path.carries}`),
    el("p", {}, `round trip ${ms(path.rtt)}${jitter}, ${both("loss", percent, path.loss)}, ${both("bytes", rate, path.rate)}`),
    el("div", { class: "plots" }, figure("loss", percent, 1), figure("bytes", rate, 2)));
}

// Tables. Roles are written down: a browser forgets those of a table that is shown in another way on a phone.

function rows(tag, ...lines) {
  return el(tag, { role: "rowgroup" }, lines.map(([cells, more]) => el("tr", { role: "row", ...more }, cells)));
}
function heading(more, ...content) { return el("th", { scope: "col", role: "columnheader", ...more }, content); }

function list(lines, titles) {
  const cell = (text, index) => el("td", { role: "cell", "data-title": titles[index] }, typeof text === "number" ? count(text) : text);
  return el("table", { role: "table", class: "list" },
    rows("thead", [titles.map((title) => heading({}, title))]),
    rows("tbody", ...lines.map((line) => [line.map(cell)])));
}

const CELLS = { vehicle: link, state, since: age, "round trip": ms, loss: percent, in: rate, out: rate };

function table(id) {
  const { order: [column, direction], columns } = TABLES[id], isPeers = id === "peers";
  const all = isPeers ? (now.rows || []).map(row) : Object.entries(now.members || {}).map(member);
  const section = at(id), wanted = section.querySelector("input").value.toLowerCase();
  const value = (row) => (columns[column] === "state" ? ORDER.indexOf(row[column]) : row[column]);
  const unknown = (row) => value(row) === null || value(row) === ""; // last, in either direction
  const compare = (a, b) => (typeof a === "string" ? a.localeCompare(b, "en", { numeric: true }) : a - b);
  const shown = all.filter((row) => row.some((cell) => String(cell).toLowerCase().includes(wanted)));
  shown.sort((a, b) => unknown(a) - unknown(b) || direction * compare(value(a), value(b)) || compare(a[0], b[0]));
  const isPlotted = isPeers && Object.keys(plotted).length > 0;
  const sorted = (index) => (index !== column ? false : direction > 0 ? "ascending" : "descending");
  const head = columns.map((title, index) => heading({ "aria-sort": sorted(index) },
    el("button", { type: "button", "data-column": String(index) }, title)));
  const plain = (is) => (is === null || is === "" ? "-" : is);
  const cell = (text, index) => el("td", { role: "cell", "data-title": columns[index] }, (CELLS[columns[index]] || plain)(text));
  const drawn = (name) => {
    const lines = together(plotted[name]);
    return el("td", { role: "cell", class: "drawn" }, lines === null ? "-" : plot(`round trip of ${name}`, ms, lines, 0)[1]);
  };
  const body = shown.map((row) => [
    [...row.map(cell), isPlotted ? drawn(row[0]) : null],
    { "data-key": row[0], class: lost === null ? row[1] : "unknown" },
  ]);
  section.hidden = !all.length;
  morph(section.querySelector("table"), el("table", { role: "table" },
    rows("thead", [[...head, isPlotted ? heading({ class: "drawn" }, "last ten minutes", axis()) : null]]),
    rows("tbody", ...body)));
}

function rest({ endpoints, networks, lines }) {
  const clients = (endpoint) => endpoint.clients.map(([address, silent]) => `${address} (${age(silent)})`).join(", ") || "no client";
  const panel = (title, rows, content) => (rows.length ? [el("section", { class: "panel", "data-key": title }, el("h2", {}, title), content)] : []);
  return [
    ...panel("Local endpoints", endpoints, list(
      endpoints.map((endpoint) => [endpoint.name, clients(endpoint), ...endpoint.frames, endpoint.problems || "-"]),
      ["endpoint", "clients (silent)", "frames in", "frames out", "problems"])),
    ...panel("Networks", networks, list(
      networks.map((network) => [network.name, network.exit, network.is_metered ? "metered" : "-", network.text]),
      ["network", "exit", "metered", "addresses"])),
    ...panel("This daemon", lines, lines.map((line) => el("p", { class: line.is_good ? false : "warning" }, line.text))),
  ];
}

function past(lines) {
  const newest = [...lines].sort((a, b) => (b.ended_s === null) - (a.ended_s === null) || a.began_s - b.began_s);
  if (!newest.length) return [];
  const ended = (line) => (line.ended_s === null ? "lasts" : clock(line.ended_s));
  const what = (line) => el("span", {}, quoted(`${line.text}. Remedy: ${line.remedy}.`));
  const log = newest.map((line) => [clock(line.began_s), ended(line), line.severity, line.name || "-", what(line)]);
  return [el("details", { "data-key": "past" }, el("summary", {}, `Problems in the log: ${newest.length}`),
    list(log, ["began", "ended", "kind", "of", "what"]))];
}

function overall() { // members that never came do not count while frames pass
  if (now.problems.some((line) => line.severity === "security")) return "attack";
  if (now.frames_pass) return now.problems.length ? "warning" : "up";
  return ["up", "warning"].includes(now.worst) ? "blocked" : now.worst;
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
  fill(at("state"), peer ? now.cards.map((facts) => state(facts.word)) : [state(overall())]);
  at("fleet").textContent = peer ? now.daemon : now.fleet;
  at("clock").textContent = lost === null ? `live ${now.seen}` : "";
  const missing = peer && !now.cards.length ? [el("span", { class: "bad" }, `${now.daemon} has no peer of this name`)] : [];
  const said = [...missing, ...now.headline.map((part) => el("span", { class: part.is_good ? "good" : "bad" }, part.text))];
  fill(at("headline"), lost === null ? said : [el("span", { class: "bad" }, `LOST: ${lost}. What is below was true at ${now.seen}.`)]);
  fill(at("problems"), problems(now.problems));
  fill(at("cards"), now.cards.map(card));
  for (const id of Object.keys(TABLES)) table(id);
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
        lines.forEach((points, index) => { kept[index] = [...kept[index], ...points].slice(-SAMPLES); });
      }
    }
  });
  source.addEventListener("error", ({ target }) => {
    if (target === source && target.readyState === EventSource.CLOSED) setTimeout(listen, 2000); // refused: the browser gives up
  });
}

for (const id of Object.keys(TABLES)) {
  const section = at(id), shown = () => now && table(id);
  section.addEventListener("input", shown);
  section.addEventListener("click", (event) => {
    const column = Number(event.target.dataset.column), order = TABLES[id].order;
    if (Number.isNaN(column)) return;
    TABLES[id].order = [column, order[0] === column ? -order[1] : 1];
    shown();
  });
}
at("problems").addEventListener("click", async (event) => {
  const command = event.target.closest("[data-copy]")?.dataset.copy;
  if (command === undefined) return;
  try { await navigator.clipboard.writeText(command); } catch { return; } // the browser's owner forbids it
  copied = command;
  at("said").textContent = `Copied: ${command}`;
  render();
  setTimeout(() => { copied = at("said").textContent = ""; render(); }, COPIED_MS);
});
document.addEventListener("visibilitychange", () => { // a browser has six connections to a server, for all its tabs
  source?.close();
  heardAt = performance.now();
  listen();
});
setInterval(() => {
  if (!document.hidden && performance.now() - heardAt > LOST_MS) lose("the page's server does not answer");
}, 500);
listen();
