// Clips as they come from the server (clips.py writes them): the scene that they show at any time.

const DIGITS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

/** Whole numbers from a text: of each the sign and five bits a letter, the low ones first, and 32 more where it goes on. */
export function readNumbers(text) {
  const numbers = [];
  let rest = 0;
  let place = 1;
  for (const letter of text) {
    const digit = DIGITS.indexOf(letter);
    rest += (digit % 32) * place;
    place *= 32;
    if (digit < 32) {
      numbers.push(rest % 2 ? -(rest + 1) / 2 : rest / 2);
      rest = 0;
      place = 1;
    }
  }
  return numbers;
}

/** A number at every moment, from its first value and its changes; one that never changes stays a number. */
function readTrack(track) {
  if (typeof track === "number") return track;
  let sum = 0;
  return readNumbers(track).map((change) => (sum += change));
}

/** The value of a track `time` moments after its start, on a straight line between two of them. */
function valueAt(track, time) {
  if (typeof track === "number") return track;
  const last = track.length - 1;
  const before = Math.min(Math.floor(time), last);
  const after = Math.min(before + 1, last);
  return track[before] + (track[after] - track[before]) * Math.min(time - before, 1);
}

/** A value, or that of the latest moment that has one of its own. */
function latest(changes, time) {
  if (!Array.isArray(changes)) return changes;
  let value = changes[0][1];
  for (const [moment, other] of changes) if (moment <= time) value = other;
  return value;
}

export class Clip {
  /** A clip in what all clips of its environment share. */
  constructor(view, clip) {
    this.view = view;
    this.steps = clip.steps;
    this.seconds = clip.steps * view.step_seconds;
    this.extent = clip.extent.map(readTrack);
    this.shapes = [];
    for (const entry of clip.shapes) {
      if (Array.isArray(entry)) {
        for (let place = entry[0]; place <= entry[1]; place++) this.shapes.push(view.shapes[place]);
      } else {
        this.shapes.push(...repeated({ ...entry, at: entry.at.map(readTrack) }));
      }
    }
  }

  /** Whether the view stays where it is. */
  get still() {
    return this.extent.every((track) => typeof track === "number");
  }

  /** The scene after `time` steps, in the environment's units, as `Scene.as_dict` has it; as it ended after the end. */
  sceneAt(time) {
    const now = Math.max(0, Math.min(time, this.steps));
    const extent = this.extent.map((track) => valueAt(track, now));
    const shapes = [];
    for (const shape of this.shapes) {
      const moment = now - (shape.from ?? 0);
      if (moment < 0 || Math.floor(moment) >= (shape.moments ?? Infinity)) continue;
      shapes.push(this.shapeAt(shape, moment, extent));
    }
    const grid = this.view.grid;
    return {
      extent: extent.map((number) => number * grid),
      y_down: this.view.y_down,
      background: this.view.background,
      shapes,
    };
  }

  shapeAt(shape, moment, extent) {
    const grid = this.view.grid;
    const at = shape.at.map((track) => valueAt(track, moment));
    const places = shape.kind === "polyline" ? at.length : 2;
    const numbers = at.map((number, place) => (number + (shape.along && place < places ? extent[2 * (place % 2)] : 0)) * grid);
    const colour = latest(shape.colour, moment);
    const outline = latest(shape.outline, moment) ?? null;
    const [x, y] = numbers;
    switch (shape.kind) {
      case "rectangle": {
        const angle = at[4] * this.view.turn;
        return { kind: "rectangle", x, y, width: numbers[2], height: numbers[3], angle, colour, outline };
      }
      case "circle":
        return { kind: "circle", x, y, radius: numbers[2], colour, outline };
      case "text":
        return { kind: "text", x, y, text: latest(shape.text, moment), colour };
      default: {
        const points = [];
        for (let place = 0; place < numbers.length; place += 2) points.push([numbers[place], numbers[place + 1]]);
        return { kind: "polyline", points, colour };
      }
    }
  }

  /** Where the agents have been until `time` steps, if the view stays where it is: lists of points. */
  routesUntil(time) {
    if (!this.still) return [];
    const moves = (shape) => shape.kind === "circle" && shape.at.slice(0, 2).some((track) => typeof track !== "number");
    const now = Math.max(0, Math.min(time, this.steps));
    const moments = [...Array(Math.floor(now) + 1).keys(), now];
    const place = (shape, moment) => [0, 1].map((axis) => valueAt(shape.at[axis], moment) * this.view.grid);
    return this.shapes.filter(moves).map((shape) => moments.map((moment) => place(shape, moment)));
  }
}

function repeated(shape) {
  if (!shape.repeats) return [shape];
  const [count, x, y] = shape.repeats;
  return [...Array(count).keys()].map((place) => ({
    ...shape,
    at: shape.at.map((number, at) => number + place * (at % 2 ? y : x)),
  }));
}
