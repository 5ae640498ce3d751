// Requests to the server. The token stands in the address's fragment, which browsers send nowhere, and goes as a bearer header.

const PATIENCE = 10_000; // ms until a request counts as lost
const WAITS = [500, 1000, 2000, 4000]; // ms before it is tried again; the last one from then on

/** The server said no. */
export class Refused extends Error {
  constructor(status, message) {
    super(message);
    this.status = status;
  }
}

export function token() {
  return location.hash.slice(1);
}

/** A random identity for a request, RFC 4122's version 4; `crypto.randomUUID` isn't there on plain HTTP. */
export function identity() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  bytes[6] = (bytes[6] & 0x0f) | 0x40;
  bytes[8] = (bytes[8] & 0x3f) | 0x80;
  const digits = [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  return digits.replace(/^(.{8})(.{4})(.{4})(.{4})(.{12})$/, "$1-$2-$3-$4-$5");
}

/** One request, as it is. Throws `Refused`, or another error where no answer came. */
async function once(path, body) {
  const headers = { Authorization: `Bearer ${token()}` };
  if (body !== undefined) headers["Content-Type"] = "application/json";
  const reply = await fetch(path, {
    method: body === undefined ? "GET" : "POST",
    headers,
    body: body === undefined ? undefined : JSON.stringify(body),
    cache: "no-store",
    credentials: "omit",
    signal: AbortSignal.timeout(PATIENCE),
  });
  if (reply.status >= 500) throw new Error(`status ${reply.status}`);
  if (reply.ok) return reply;
  const told = await reply.json().catch(() => ({}));
  throw new Refused(reply.status, told.error ?? `status ${reply.status}`);
}

/**
 * What the server answers, asked again and again while there is no answer: what is sent has to bear that.
 * `onTrouble` is told true when an answer doesn't come, and false when it has come after all.
 */
export async function call(path, body, onTrouble = () => {}, read = (reply) => reply.json()) {
  for (let tries = 0; ; tries++) {
    try {
      const answer = await read(await once(path, body));
      if (tries) onTrouble(false);
      return answer;
    } catch (error) {
      if (error instanceof Refused) {
        if (tries) onTrouble(false);
        throw error;
      }
      onTrouble(true);
      await pause(WAITS[Math.min(tries, WAITS.length - 1)]);
    }
  }
}

/** Waits, or until the network is back. */
function pause(time) {
  return new Promise((resolve) => {
    const timer = setTimeout(done, time);
    addEventListener("online", done);
    function done() {
      clearTimeout(timer);
      removeEventListener("online", done);
      resolve();
    }
  });
}
