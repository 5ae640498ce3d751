// Plays clips side by side, all from their start on, and counts what was drawn of them.
//
// They play at the same time, again and again: both begin alike, so a difference is seen when it happens, nothing has to be
// remembered from one to the other, and neither is the one that was seen last. It takes half the time, too.
//
// Time is what was drawn: a frame moves the clips by at most LONGEST, and nothing moves or counts while the page is hidden. So a
// clip that has come to its end was on the screen from its start to its end.

import { Clip } from "./clip.js";
import { draw, fit } from "./drawing.js";

const LONGEST = 50; // ms that one frame may move a clip
const PAUSE = 900; // ms that clips stand at their end before they begin again

export class Player {
  /**
   * `stages`: for each clip { canvas, box }, the canvas and the element that bounds it.
   * `onSeen`: called once, when every clip has been drawn to its end.
   * `onTime`: called in every frame with the share of the longest clip that is over, from 0 to 1.
   */
  constructor(stages, view, clips, { onSeen = () => {}, onTime = () => {} } = {}) {
    this.stages = stages;
    this.clips = clips.map((clip) => new Clip(view, clip));
    this.view = view;
    this.onSeen = onSeen;
    this.onTime = onTime;
    this.frames = clips.map(() => 0);
    this.ended = clips.map(() => false);
    this.seen = false;
    this.watched = 0; // ms
    this.hidden = 0; // ms
    this.replays = 0;
    this.began = null; // when the first frame was drawn
    this.time = 0; // ms of the clips
    this.last = null; // when the last frame was drawn
    this.hiddenSince = null;
    this.longest = 1000 * Math.max(...this.clips.map((clip) => clip.seconds));
  }

  start() {
    this.stop();
    this.stopping = new AbortController();
    const { signal } = this.stopping;
    document.addEventListener("visibilitychange", () => this.noticeVisibility(), { signal });
    this.noticeVisibility();
    const sizes = new ResizeObserver(() => this.resize());
    this.stages.forEach(({ box }) => sizes.observe(box));
    signal.addEventListener("abort", () => sizes.disconnect());
    this.resize();
    const tick = (now) => {
      if (signal.aborted) return;
      this.frame(now);
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  stop() {
    this.stopping?.abort();
  }

  /** From the start again, because somebody wants to see it. */
  replay() {
    this.replays += 1;
    this.time = 0;
  }

  /** What is reported of how the clips were watched. */
  report() {
    this.noticeVisibility();
    const now = performance.now();
    return {
      reaction_ms: Math.round(this.began === null ? 0 : now - this.began),
      watched_ms: Math.round(this.watched),
      hidden_ms: Math.round(this.hidden),
      replays: this.replays,
    };
  }

  noticeVisibility() {
    const now = performance.now();
    if (this.hiddenSince !== null) this.hidden += now - this.hiddenSince;
    this.hiddenSince = document.visibilityState === "visible" ? null : now;
    if (this.hiddenSince !== null) this.last = null;
  }

  resize() {
    this.rooms = this.stages.map(({ canvas, box }) => {
      const { width, height } = box.getBoundingClientRect();
      return width && height ? fit(canvas, this.view, width, height) : null;
    });
    this.paint();
  }

  frame(now) {
    if (document.visibilityState !== "visible" || this.rooms.some((room) => room === null)) {
      this.last = null;
      return;
    }
    const passed = this.last === null ? 0 : Math.min(Math.max(now - this.last, 0), LONGEST);
    this.last = now;
    this.began ??= performance.now();
    this.watched += passed;
    this.time += passed;
    if (this.time > this.longest + PAUSE) this.time = 0;
    this.paint();
    this.clips.forEach((clip, place) => {
      if (this.time <= 1000 * clip.seconds) this.frames[place] += 1;
      else if (!this.ended[place]) {
        this.frames[place] += 1;
        this.ended[place] = true;
      }
    });
    this.onTime(Math.min(this.time / this.longest, 1));
    if (!this.seen && this.ended.every(Boolean)) {
      this.seen = true;
      this.onSeen();
    }
  }

  paint() {
    this.clips.forEach((clip, place) => {
      const room = this.rooms[place];
      if (room === null) return;
      const time = this.time / 1000 / this.view.step_seconds;
      draw(this.stages[place].canvas, clip.sceneAt(time), room, this.view.colours, clip.routesUntil(time));
    });
  }
}
