// The researcher's page: asks how the study stands, every two seconds while somebody looks at it.

import { Refused, call, token } from "./api.js";

const $ = (id) => document.getElementById(id);
const EVERY = 2000; // ms
const HERE = 60; // s since a request from which on somebody counts as away
const KEPT = 300; // rates in the little curve

const rates = [];
let picture = null; // the path of the one that is shown
let url = null;
let round = null; // its number, of the one that is shown

function trouble(is) {
  $("trouble").textContent = is ? "The server doesn’t answer. Trying again …" : "";
  $("trouble").hidden = !is;
  live(!is);
}

function live(is) {
  $("live").dataset.on = is;
  $("live").textContent = is ? `live, ${new Date().toLocaleTimeString()}` : "not connected";
}

const pause = (time) => new Promise((resolve) => setTimeout(resolve, time));

async function begin() {
  if (!token()) {
    refuse("The address is incomplete: open the whole link that the server printed.");
    return;
  }
  for (;;) {
    try {
      await show(await call("/api/researcher", undefined, trouble));
    } catch (error) {
      if (!(error instanceof Refused)) throw error;
      refuse(error.message);
      return;
    }
    await pause(EVERY);
    while (document.visibilityState !== "visible") await pause(EVERY / 4);
  }
}

function refuse(text) {
  $("refused").textContent = text;
  $("refused").hidden = false;
  $("all").hidden = true;
  $("live").hidden = true;
}

const share = (value) => (value === null || value === undefined ? "–" : `${Math.round(100 * value)} %`);

async function show(now) {
  live(true);
  $("all").hidden = false;
  if (now.title) document.title = $("title").textContent = now.title;
  tiles(now);
  people(now.participants);
  rounds(now.round);
  $("training").hidden = !now.picture;
  $("training-note").textContent = now.routes?.note ?? "";
  if (now.picture && now.picture !== picture) await fetchPicture(now.picture);
}

function tiles(now) {
  const here = now.participants.filter(isHere).length;
  const done = now.participants.filter((one) => one.page === "done").length;
  const failed = now.participants.map((one) => one.checks_failed);
  $("present").textContent = here;
  $("present-more").textContent = `${done} of ${now.participants.length} done`;
  $("answers").textContent = now.answers + now.ratings;
  $("answers-more").textContent = now.ratings ? `${now.answers} pairs, ${now.ratings} ratings` : "";
  $("rate").textContent = Math.round(now.answers_per_minute);
  $("agreement").textContent = share(now.agreement);
  $("repeats").textContent = share(now.repeat_consistency);
  $("left").textContent = share(now.left_share);
  $("checks").textContent = failed.reduce((sum, number) => sum + number, 0);
  $("checks").dataset.warn = failed.some(Boolean);
  $("checks-more").textContent = failed.some(Boolean) ? `by ${counted(failed.filter(Boolean).length)}` : "";
  rates.push(now.answers_per_minute);
  if (rates.length > KEPT) rates.shift();
  curve($("rates"));
}

function curve(canvas) {
  const dots = devicePixelRatio || 1;
  canvas.width = canvas.clientWidth * dots;
  canvas.height = canvas.clientHeight * dots;
  const context = canvas.getContext("2d");
  const most = Math.max(...rates, 1);
  context.beginPath();
  rates.forEach((rate, place) => {
    const x = rates.length > 1 ? (place / (rates.length - 1)) * canvas.width : 0;
    context.lineTo(x, canvas.height - dots - (rate / most) * (canvas.height - 3 * dots));
  });
  context.strokeStyle = getComputedStyle(document.body).getPropertyValue("--agent");
  context.lineWidth = 2 * dots;
  context.lineJoin = "round";
  context.stroke();
}

const counted = (people) => (people === 1 ? "1 person" : `${people} people`);

const isHere = (one) => one.page !== "done" && one.last_seen_s !== null && one.last_seen_s < HERE;

/** One row for each participant; rows stay the same elements, so that a reader's place and selection stay too. */
function people(participants) {
  $("nobody").hidden = participants.length > 0;
  const body = $("people");
  participants.forEach((one, place) => {
    const row = body.rows[place] ?? newRow(body);
    row.dataset.here = isHere(one);
    const [number, phase, where, done, seen, checks] = row.cells;
    set(number.lastChild, one.number);
    set(phase, one.phase);
    set(where, one.outcome === "declined" ? "declined" : one.page);
    done.firstChild.max = Math.max(one.total, 1);
    done.firstChild.value = one.done;
    done.firstChild.setAttribute("aria-label", `Participant ${one.number}`);
    set(done.lastChild, `${one.done} of ${one.total}`);
    set(seen, one.last_seen_s === null ? "–" : ago(one.last_seen_s));
    set(checks, one.checks_failed);
    checks.dataset.warn = one.checks_failed > 0;
  });
  while (body.rows.length > participants.length) body.deleteRow(-1);
}

function newRow(body) {
  const row = body.insertRow();
  for (let place = 0; place < 6; place++) row.insertCell();
  const dot = Object.assign(document.createElement("span"), { className: "dot" });
  row.cells[0].append(dot, document.createElement("span"));
  row.cells[3].append(document.createElement("progress"), document.createElement("span"));
  return row;
}

function set(element, value) {
  if (element.textContent !== String(value)) element.textContent = value;
}

function ago(seconds) {
  if (seconds < 5) return "now";
  if (seconds < 90) return `${Math.round(seconds)} s ago`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min ago`;
  return `${Math.round(seconds / 3600)} h ago`;
}

function rounds(now) {
  $("round").hidden = now === null || now === undefined;
  if ($("round").hidden) return;
  if (now.number !== round) $("close-sure").hidden = $("close-refused").hidden = true;
  round = now.number;
  const open = now.state === "open";
  set($("round-title"), `Round ${now.number}, ${now.state}`);
  $("round-bar").max = Math.max(now.asked, 1);
  $("round-bar").value = now.answered;
  set($("round-count"), `${now.answered} of ${now.asked} answered, ${open ? "open" : "was open"} for ${span(now.open_s)}`);
  set($("round-says"), now.says ?? "");
  $("close").hidden = !open || !$("close-sure").hidden;
  if (!open) $("close-sure").hidden = true;
  $("close").setAttribute("aria-disabled", String(now.can_close === false));
  set($("close-text"), `Close round ${now.number} with ${now.answered} of ${now.asked} answers? Later answers to it are kept, and not learned from.`);
}

const span = (seconds) => (seconds < 90 ? `${Math.round(seconds)} s` : `${Math.round(seconds / 60)} min`);

$("close").onclick = () => {
  if ($("close").getAttribute("aria-disabled") === "true") return;
  $("close-refused").hidden = true;
  $("close").hidden = true;
  $("close-sure").hidden = false;
  $("close-no").focus();
};

$("close-no").onclick = () => {
  $("close-sure").hidden = true;
  $("close").hidden = false;
  $("close").focus();
};

$("close-yes").onclick = async () => {
  $("close-sure").hidden = true;
  try {
    await call("/api/researcher/close_round", { round }, trouble);
    await show(await call("/api/researcher", undefined, trouble));
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    $("close-refused").textContent = error.message;
    $("close-refused").hidden = false;
  }
};

/** Pictures need the token too, so they are fetched and not linked. */
async function fetchPicture(path) {
  try {
    const content = await call(path, undefined, trouble, (reply) => reply.blob());
    const before = url;
    $("picture").src = url = URL.createObjectURL(content);
    await $("picture").decode();
    if (before) URL.revokeObjectURL(before);
    picture = path;
  } catch (error) {
    if (error instanceof Refused || error.name === "EncodingError") return; // it is being written: the next look will find it
    throw error;
  }
}

addEventListener("hashchange", () => location.reload());

begin();
