// The participants' page. The server knows where a participant is; the page asks it, shows that, and sends what was said.

import { Refused, call, identity, token } from "./api.js";
import { Player } from "./player.js";

const $ = (id) => document.getElementById(id);
const WIDE = 3; // times its height, a scene that lies in a strip
const FLASH = 180; // ms for which one sees what one has chosen
const WAITS = [300, 700, 1500, 3000]; // ms between questions of one who waits; the last one from then on
const LONG = 5; // s of waiting from which on it is said how long
const ENOUGH = { frames: 25, width: 600, height: 480 }; // frames a second, pixels
const MEASURED = 1000; // ms for which frames are counted
const PLATFORMS = ["PROLIFIC_PID", "STUDY_ID", "SESSION_ID", "workerId", "assignmentId", "hitId", "turkSubmitTo"];
const PREVIEW = "ASSIGNMENT_ID_NOT_AVAILABLE"; // MTurk's, while somebody only looks
const MEANINGS = ["not important", "slightly important", "important", "very important", "most important"];

let view = null; // what all clips share
let player = null; // of what is on the screen
let press = () => false; // what a key does here, true if anything
let notice = ""; // what is said beside the next thing that is shown
let waits = 0; // how often somebody who waits has asked
let visit = 0; // counts where one has been: what was begun before is over

// --- what is sent -----------------------------------------------------------------------------------------------------------

function trouble(is, text) {
  if (is) $("trouble").textContent = text;
  $("trouble").hidden = !is;
}

const ask = (path) => call(path, undefined, (is) => trouble(is, "Connection lost. Trying again …"));

/**
 * Sends something and keeps it until the server has it. History entries outlive a reload, belong to this address with its token,
 * and are there inside a platform's frame, where cookies and storage may not be.
 */
async function send(path, body) {
  history.replaceState({ kept: { path, body } }, "");
  try {
    return await call(path, body, (is) => trouble(is, "Connection lost. Your answer is kept, trying again …"));
  } finally {
    history.replaceState(null, "");
  }
}

/** Sends what was kept when the page was closed; if it isn't wanted any more, it had arrived. */
async function sendKept() {
  const kept = history.state?.kept;
  if (!kept) return;
  try {
    const { token: own } = await send(kept.path, kept.body);
    if (own) enter(own);
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
  }
}

// --- where we are -----------------------------------------------------------------------------------------------------------

async function begin() {
  if (!token()) {
    refuse("The address is incomplete. Please open the whole link that you were given.");
    return;
  }
  await guarded(async () => {
    await sendKept();
    go(await ask("/api/state"));
  });
}

/** Does `action`, and what has to be done if the server says no. */
async function guarded(action) {
  try {
    await action();
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    if (error.status === 409) {
      // said in another tab, or before a reload: go on from where the server is
      notice = "That one was answered already. ";
      await pause(WAITS[0]);
      await guarded(async () => go(await ask("/api/state")));
    } else if (error.status === 429) {
      refuse("Too many attempts with links that don’t work. Please try again in a few minutes.", error.message);
    } else if (error.status === 401 || error.status === 403) {
      refuse("Please open the link again as it was given to you, or ask who gave it to you.", error.message);
    } else {
      refuse("Something went wrong. Please load the page again; your answers are safe.", error.message);
    }
  }
}

function refuse(text, why = "") {
  $("refused-title").textContent = why && !text.startsWith("Please") ? "That didn’t work" : "This link doesn’t work";
  $("refused-text").textContent = text;
  $("refused-why").textContent = why;
  turnTo("refused");
}

const PAGES = { consent, check, instructions, importance, pairs, ratings, wait, done };

/** Shows where `state` says that the participant is; what is done there begins a chain of its own. */
function go(state) {
  visit += 1;
  $("title").textContent = state.title;
  document.title = state.title;
  guarded(() => PAGES[state.page](state));
}

/** Shows one page and hides the others; returns whether a later step still belongs to it. */
function turnTo(page) {
  visit += 1;
  player?.stop();
  player = null;
  press = () => false;
  const watching = page === "pairs" || page === "ratings";
  const before = document.querySelector("section:not([hidden])");
  for (const section of document.querySelectorAll("section")) section.hidden = section.dataset.page !== page;
  if (!watching) $("progress").hidden = true;
  $("practice-mark").hidden = true;
  const section = document.querySelector(`section[data-page="${page}"]`);
  if (before !== section) {
    scrollTo(0, 0);
    section.querySelector("h1")?.focus({ preventScroll: true });
  }
  return still();
}

/** Leaves what is shown; returns whether a later step still belongs to it. */
function still() {
  const here = visit;
  return () => here === visit;
}

function paragraphs(box, texts) {
  box.replaceChildren(...texts.map((text) => made("p", {}, text)));
}

function progress(done, total, text) {
  $("progress").hidden = false;
  $("progress-bar").max = Math.max(total, 1);
  $("progress-bar").value = done;
  $("progress-text").textContent = text;
}

function enable(buttons, can) {
  for (const button of buttons) button.setAttribute("aria-disabled", String(!can));
}

const can = (button) => button.getAttribute("aria-disabled") !== "true";

/** Lets `button` do `action` once; again only if that led nowhere. */
function onClick(button, action) {
  enable([button], true);
  button.onclick = async () => {
    if (!can(button)) return;
    const there = still();
    enable([button], false);
    await guarded(action);
    if (there()) enable([button], true);
  };
}

const pause = (time) => new Promise((resolve) => setTimeout(resolve, time));

// --- consent, check, instructions, importance -------------------------------------------------------------------------------

function consent(state) {
  turnTo("consent");
  paragraphs($("consent-text"), state.texts.consent);
  const address = new URLSearchParams(location.search);
  const platform = Object.fromEntries([...address].filter(([name, text]) => PLATFORMS.includes(name) && text));
  const preview = Object.values(platform).includes(PREVIEW);
  note(preview ? "This is a preview. Accept the task on the platform to take part." : "");
  for (const id of ["agree", "decline"]) $(id).hidden = preview;
  $("decline-sure").hidden = true;
  const say = async (agreed) => {
    try {
      const { token: own, ...reply } = await send("/api/consent", { agreed, platform });
      if (own) enter(own);
      go(reply);
    } catch (error) {
      // what the server wants to be told to whoever reads this page: no id of the platform, nothing to rate yet
      if (!(error instanceof Refused) || ![400, 409].includes(error.status)) throw error;
      note(error.message);
    }
  };
  onClick($("agree"), () => say(true));
  onClick($("decline-yes"), () => say(false));
  $("decline").onclick = () => {
    $("decline-sure").hidden = false;
    $("decline-no").focus();
  };
  $("decline-no").onclick = () => {
    $("decline-sure").hidden = true;
    $("agree").focus();
  };
}

function note(text) {
  $("consent-note").textContent = text;
  $("consent-note").hidden = !text;
}

/** From now on this is the address, with a token of the participant's own; a platform's ids have done their work. */
function enter(own) {
  history.replaceState(null, "", `${location.pathname}#${own}`);
}

async function check() {
  const there = turnTo("check");
  const report = {};
  onClick($("check-on"), async () => go(await send("/api/proceed", { page: "check", report })));
  onClick($("check-again"), () => check());
  enable([$("check-on")], false);
  $("check-again").hidden = $("check-advice").hidden = true;
  const items = ["Picture", "Window", "Keys or touch"].map((text) => made("li", {}, text));
  $("checks").replaceChildren(...items);
  const touch = matchMedia("(pointer: coarse)").matches;
  Object.assign(report, {
    frames_per_second: await framesPerSecond(there),
    width: innerWidth,
    height: innerHeight,
    pixel_ratio: Math.round(100 * devicePixelRatio) / 100,
    touch,
  });
  if (!there()) return;
  const smooth = report.frames_per_second >= ENOUGH.frames;
  const large = report.width >= ENOUGH.width && report.height >= ENOUGH.height;
  const told = [
    [smooth, `Picture: ${report.frames_per_second} frames a second`],
    [large, `Window: ${report.width} by ${report.height} pixels`],
    [true, touch ? "Touch: you will answer with buttons" : "Keys: you can answer with the arrow keys or with buttons"],
  ];
  told.forEach(([good, text], place) => {
    items[place].dataset.good = good;
    items[place].textContent = text;
  });
  const advice = [];
  if (!smooth) advice.push("The picture isn’t smooth. Closing other programs and tabs may help.");
  if (!large) advice.push("The window is small. Please make it larger, or turn the tablet on its side.");
  $("check-advice").textContent = advice.join(" ");
  $("check-advice").hidden = !advice.length;
  $("check-again").hidden = !advice.length;
  enable([$("check-on")], true);
  $("check-on").focus();
}

/** Frames a second of a dot that moves, counted while the page is visible. */
function framesPerSecond(there) {
  const canvas = $("check-canvas");
  const dots = devicePixelRatio || 1;
  canvas.width = canvas.clientWidth * dots;
  canvas.height = canvas.clientHeight * dots;
  const context = canvas.getContext("2d");
  return new Promise((resolve) => {
    let frames = 0;
    let time = 0;
    let last = null;
    const tick = (now) => {
      if (!there()) return;
      if (document.visibilityState === "visible" && last !== null) {
        time += now - last;
        frames += 1;
      }
      last = document.visibilityState === "visible" ? now : null;
      const [width, height, radius] = [canvas.width, canvas.height, 11 * dots];
      context.clearRect(0, 0, width, height);
      context.fillStyle = "#2f9e78";
      context.beginPath();
      context.arc(radius * 2 + (width - 4 * radius) * Math.min(time / MEASURED, 1), height / 2, radius, 0, 2 * Math.PI);
      context.fill();
      if (time >= MEASURED) resolve(Math.round((1000 * frames) / time));
      else requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  });
}

function instructions(state) {
  turnTo("instructions");
  paragraphs($("instructions-text"), state.texts.instructions);
  const rates = state.phase === "testing";
  $("keys-pairs").hidden = rates;
  $("keys-ratings").hidden = !rates;
  const practises = state.phase === "training";
  $("instructions-on").textContent = practises ? "Try two for practice" : "Continue";
  onClick($("instructions-on"), () => (practises ? practise(state) : ready(state)));
}

async function practise(state) {
  const [{ pairs: tried }] = await Promise.all([ask("/api/practice"), lookAround()]);
  for (const [place, pair] of tried.entries()) await compared({ ...pair, place, total: tried.length }, true);
  ready(state);
}

function ready(state) {
  turnTo("ready");
  onClick($("read-again"), () => instructions(state));
  onClick($("begin"), async () => go(await send("/api/proceed", { page: "instructions", report: {} })));
}

function importance(state) {
  turnTo("importance");
  const form = $("importance");
  const request = identity();
  $("importance-items").replaceChildren(...state.importance.map(importanceOf));
  const groups = [...form.querySelectorAll(".item")];
  const chosen = (group) => group.querySelector("input:checked");
  const all = () => enable([$("importance-on")], groups.every(chosen));
  all();
  form.onchange = all;
  form.onsubmit = (event) => event.preventDefault();
  const answer = (group, place) => Number(chosen(group).value);
  onClick($("importance-on"), async () => {
    const answers = Object.fromEntries(state.importance.map((item, place) => [item.name, answer(groups[place])]));
    go(await send("/api/importance", { answers, request }));
  });
  press = (key) => {
    if (!/^[1-5]$/.test(key)) return false;
    const at = groups.find((group) => group.contains(document.activeElement)) ?? groups.find((group) => !chosen(group));
    if (!at) return false;
    at.querySelector(`input[value="${key}"]`).checked = true;
    all();
    const next = groups[groups.indexOf(at) + 1];
    (next ? (chosen(next) ?? next.querySelector("input")) : $("importance-on")).focus();
    return true;
  };
}

function importanceOf(item, place) {
  const text = made("p", { id: `item-${place}` }, item.text);
  const steps = MEANINGS.map((meaning, step) => {
    const input = made("input", { type: "radio", name: text.id, value: step + 1, "aria-label": `${step + 1}, ${meaning}` });
    return made("label", {}, input, String(step + 1));
  });
  const group = made("div", { class: "steps", role: "radiogroup", "aria-labelledby": text.id }, ...steps);
  return made("div", { class: "item" }, text, group);
}

/** A new element with these attributes and children; texts stay texts. */
function made(kind, attributes, ...children) {
  const element = document.createElement(kind);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

// --- pairs and ratings ------------------------------------------------------------------------------------------------------

async function lookAround() {
  view ??= await ask("/api/view");
}

async function pairs() {
  const [pair] = await Promise.all([ask("/api/pair"), lookAround()]);
  if (await over(pair)) return;
  const said = await compared(pair);
  const reply = await send("/api/answer", { place: pair.place, choice: said.choice, ...said.report });
  go(reply.state);
}

async function ratings() {
  const [scene] = await Promise.all([ask("/api/scene"), lookAround()]);
  if (await over(scene)) return;
  const said = await rated(scene);
  const { frames, ...report } = said.report;
  const reply = await send("/api/rating", { place: scene.place, rating: Number(said.choice), frames: frames.clip, ...report });
  go(reply.state);
}

/** Whether there is nothing to show now; then it goes on with what there is instead. */
async function over(reply) {
  if (reply.wait === undefined && !reply.done) return false;
  if (reply.done) go(await ask("/api/state"));
  else await wait({ seconds_to_wait: reply.wait });
  return true;
}

const CHOICES = { ArrowLeft: "left", ArrowRight: "right", ArrowDown: "equal", ArrowUp: "unclear" };

/** Shows a pair until somebody has chosen: { choice, report }. */
function compared(pair, practice = false) {
  const buttons = Object.fromEntries(Object.values(CHOICES).map((choice) => [choice, $(choice)]));
  return chosen({
    page: "pairs",
    what: "Pair",
    named: { left: pair.left, right: pair.right },
    buttons,
    choiceOf: (key) => CHOICES[key],
    bar: $("pair-time"),
    replay: $("pair-replay"),
    place: pair.place,
    total: pair.total,
    practice,
  });
}

/** The same of a single scene. */
function rated(scene) {
  const numbers = [...Array(10).keys()].map((place) => place + 1);
  if (!$("ratings").children.length) {
    $("ratings").append(...numbers.map((number) => made("button", {}, String(number))));
    $("ratings").children[0].setAttribute("aria-label", "1, not at all");
    $("ratings").children[9].setAttribute("aria-label", "10, exactly");
  }
  const buttons = Object.fromEntries(numbers.map((number) => [number, $("ratings").children[number - 1]]));
  return chosen({
    page: "ratings",
    what: "Scene",
    named: { clip: scene.clip },
    buttons,
    choiceOf: (key) => (/^[0-9]$/.test(key) ? Number(key) || 10 : undefined),
    bar: $("scene-time"),
    replay: $("scene-replay"),
    place: scene.place,
    total: scene.total,
    practice: false,
  });
}

const CANVAS = { left: "left-clip", right: "right-clip", clip: "scene-clip" };

/** Shows clips until somebody has chosen one of `buttons`. */
function chosen(asked) {
  const there = turnTo(asked.page);
  const { buttons, choiceOf, replay } = asked;
  const { stages, every, announce, watch } = layOut(asked);
  const names = Object.keys(asked.named);
  const request = identity();
  announce(`${notice}Watch ${watch}.`);
  notice = "";
  waits = 0;
  return new Promise((resolve) => {
    const mine = new Player(stages, view, Object.values(asked.named), {
      onSeen: () => {
        enable(every, true);
        announce("Now choose. You may watch again as often as you like.");
      },
      onTime: (share) => (asked.bar.style.transform = `scaleX(${share})`),
    });
    player = mine;
    let said = false;
    const choose = async (choice) => {
      if (said || !there()) return;
      if (!mine.seen) {
        announce(`First watch ${watch}.`);
        return;
      }
      said = true;
      const frames = Object.fromEntries(names.map((name, place) => [name, mine.frames[place]]));
      const report = { ...mine.report(), frames, request };
      enable([...every, replay], false);
      buttons[choice].classList.add("chosen");
      announce("");
      await pause(FLASH);
      mine.stop();
      resolve({ choice, report });
    };
    const again = () => {
      if (!said && there()) mine.replay();
    };
    for (const choice of Object.keys(buttons)) buttons[choice].onclick = () => choose(choice);
    replay.onclick = again;
    press = (key) => {
      if (key === "r" || key === "R") again();
      else if (choiceOf(key) !== undefined) choose(choiceOf(key));
      else return false;
      return true;
    };
    mine.start();
  });
}

/** The page as it is before anything has been seen. */
function layOut({ page, what, named, buttons, replay, place, total, practice }) {
  const section = document.querySelector(`section[data-page="${page}"]`);
  const hint = section.querySelector(".hint");
  const every = Object.values(buttons);
  const names = Object.keys(named);
  const both = names.length > 1;
  section.classList.toggle("wide", view.width > WIDE * view.height);
  progress(place, total, `${practice ? "Practice" : what} ${place + 1} of ${total}`);
  $("practice-mark").hidden = !practice;
  for (const button of every) button.classList.remove("chosen");
  enable(every, false);
  enable([replay], true);
  const stages = names.map((name) => {
    const canvas = $(CANVAS[name]);
    canvas.setAttribute("aria-label", both ? `The ${name} clip` : "The clip");
    return { canvas, box: canvas.parentElement };
  });
  const announce = (text) => (hint.textContent = text);
  return { stages, every, announce, watch: both ? "both clips to their end" : "the clip to its end" };
}

// --- wait, done -------------------------------------------------------------------------------------------------------------

/** Asks again, soon at first and then less often; who has to wait but a moment sees no other page. */
async function wait({ seconds_to_wait: seconds }) {
  const there = waits ? turnTo("wait") : still();
  $("wait-time").textContent = seconds > LONG ? `About ${Math.ceil(seconds)} seconds.` : "";
  await pause(WAITS[Math.min(waits, WAITS.length - 1)]);
  waits += 1;
  if (there()) go(await ask("/api/state"));
}

function done(state) {
  turnTo(state.outcome === "declined" ? "declined" : "done");
  paragraphs($("thanks-text"), state.texts.thanks);
  $("code-box").hidden = state.code === null;
  $("code").textContent = state.code ?? "";
  $("copy").onclick = async () => {
    try {
      await navigator.clipboard.writeText(state.code);
      $("copy").textContent = "Copied";
    } catch {
      getSelection().selectAllChildren($("code"));
      $("copy").textContent = "Selected: copy it with Ctrl+C";
    }
  };
}

// --- keys, other tabs, the back button --------------------------------------------------------------------------------------

addEventListener("keydown", (event) => {
  if (event.repeat || event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
  if (press(event.key)) event.preventDefault();
});

addEventListener("pageshow", (event) => {
  if (event.persisted) location.reload();
});

addEventListener("hashchange", () => location.reload());

begin();
