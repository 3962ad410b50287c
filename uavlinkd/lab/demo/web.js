// The attacks of `uavlinkd demo --web`, above what the page shows. It uses the elements of page.js.
"use strict";

const attacks = el("section", { "aria-label": "Attacks" }, el("p", {}, "Asking the demo …"));
at("main").prepend(attacks);

attacks.addEventListener("click", (event) => {
  const name = event.target.dataset.attack;
  // The page has no referrer; with this one, every browser sends the origin, without which the server refuses.
  if (name) fetch(`/attacks/${name}`, { method: "POST", referrerPolicy: "same-origin" }).catch(() => {});
});

function showAttacks({ attacks: choice, running, frames, results }) {
  const words = running === null ? "Choose an attack." : `Attack: ${running} …`;
  const verdict = frames.altered ? `${count(frames.altered)} forged, altered or replayed frames were delivered` : "No forged, altered or replayed frame was delivered";
  fill(attacks, [
    el("h2", {}, "Attack this link"),
    el("p", {}, "A man in the middle is between the two daemons. It has none of their keys."),
    el("p", {}, choice.flatMap(([name, text]) => [el("button", { type: "button", "data-attack": name, disabled: running !== null }, text), " "])),
    el("p", { role: "status" }, words),
    ...(results.length ? [list(results.map(([text, attempts, counted]) => [text, count(attempts), counted || "nothing"]), ["attack", "attempts", "refused or noticed by the daemons"])] : []),
    el("p", {}, el("strong", { class: frames.altered ? "bad" : "good" }, `${verdict}.`), ` Of ${count(frames.sent)} genuine frames, ${count(frames.delivered)} were delivered.`),
  ]);
}

const attackEvents = new EventSource("/attacks");
attackEvents.onmessage = (event) => showAttacks(JSON.parse(event.data));
attackEvents.onerror = () => fill(attacks, [el("p", { class: "bad" }, "The demo does not answer: it has perhaps ended.")]);
