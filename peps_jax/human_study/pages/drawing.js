// Scenes on a canvas, in the colours and in the manner of the figures and films.

const OUTLINE = 1.2; // pixels, widths of lines
const LINE = 2.4;
const TURNED = 1.25; // a scene is turned where that makes it so much larger

/** Room on `canvas` for a scene of `view`, as large as `width` x `height` pixels allow; wide ones stand upright if that is larger. */
export function fit(canvas, view, width, height) {
  const flat = Math.min(width / view.width, height / view.height);
  const upright = Math.min(width / view.height, height / view.width);
  const turned = upright > TURNED * flat;
  const scale = turned ? upright : flat;
  const [across, down] = (turned ? [view.height, view.width] : [view.width, view.height]).map((length) => length * scale);
  const dots = window.devicePixelRatio || 1;
  canvas.style.width = `${across}px`;
  canvas.style.height = `${down}px`;
  canvas.width = Math.round(across * dots);
  canvas.height = Math.round(down * dots);
  return { scale, turned, dots, across, down };
}

/** From the environment's units to the canvas, as `DOMMatrix` has its parts. */
function matrix(scene, room) {
  const [left, right, low, high] = scene.extent;
  const scale = room.scale * room.dots;
  if (room.turned) {
    // x goes up; what is on the right of who goes along x stays on the right
    const across = scene.y_down ? [scale, -scale * low] : [-scale, scale * high];
    return [0, -scale, across[0], 0, across[1], scale * right];
  }
  const down = scene.y_down ? [scale, -scale * low] : [-scale, scale * high];
  return [scale, 0, 0, down[0], -scale * left, down[1]];
}

/** Draws `scene`, and under its last shape the `routes` that led there. */
export function draw(canvas, scene, room, colours, routes = []) {
  const context = canvas.getContext("2d");
  const colour = (role) => colours[role] ?? role;
  const parts = matrix(scene, room);
  const pen = { context, colour, parts, pixel: 1 / room.scale };
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.fillStyle = colour(scene.background);
  context.fillRect(0, 0, canvas.width, canvas.height);
  scene.shapes.forEach((shape, place) => {
    if (place === scene.shapes.length - 1) routes.forEach((points) => route(pen, points));
    context.setTransform(...parts);
    SHAPES[shape.kind](pen, shape);
  });
}

const SHAPES = {
  rectangle(pen, shape) {
    pen.context.translate(shape.x, shape.y);
    pen.context.rotate(shape.angle);
    pen.context.beginPath();
    pen.context.rect(-shape.width / 2, -shape.height / 2, shape.width, shape.height);
    fill(pen, shape);
  },
  circle(pen, shape) {
    pen.context.beginPath();
    pen.context.arc(shape.x, shape.y, shape.radius, 0, 2 * Math.PI);
    fill(pen, shape);
  },
  polyline(pen, shape) {
    line(pen, shape.points, pen.colour(shape.colour), LINE);
  },
  text(pen, shape) {
    const { context, parts } = pen;
    const [a, b, c, d, e, f] = parts;
    context.setTransform(1, 0, 0, 1, a * shape.x + c * shape.y + e, b * shape.x + d * shape.y + f);
    context.fillStyle = pen.colour(shape.colour);
    context.font = `${Math.round(13 * (window.devicePixelRatio || 1))}px system-ui, sans-serif`;
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillText(shape.text, 0, 0);
  },
};

function fill(pen, shape) {
  const { context } = pen;
  context.fillStyle = pen.colour(shape.colour);
  context.fill();
  if (shape.outline) {
    context.strokeStyle = pen.colour(shape.outline);
    context.lineWidth = OUTLINE * pen.pixel;
    context.lineJoin = "miter";
    context.stroke();
  }
}

function line(pen, points, colour, width) {
  const { context } = pen;
  context.beginPath();
  points.forEach(([x, y], place) => (place ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.strokeStyle = colour;
  context.lineWidth = width * pen.pixel;
  context.lineJoin = "round";
  context.stroke();
}

function route(pen, points) {
  const { context } = pen;
  context.setTransform(...pen.parts);
  context.globalAlpha = 0.55;
  line(pen, points, pen.colour("agent"), LINE);
  context.globalAlpha = 1;
}
