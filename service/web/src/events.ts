// Following one job: by server-sent events if the service supports them, else by polling.
//
// The stream is read with fetch, not EventSource, because EventSource cannot send a bearer token.

import { Refusal, call, getJob, isAbort } from "./api";
import { type Job, type Progress, isFinal } from "./types";

export interface Follower {
  onJob: (job: Job) => void;
  onProgress: (progress: Progress) => void;
  /** Called with an error, or with null when the service answers again. */
  onTrouble: (refusal: Refusal | null) => void;
}

interface Message {
  id: string | null;
  event: string;
  data: string;
}

/** Split a text stream into messages; comments (heartbeats) and unused fields are skipped. */
async function* messages(body: ReadableStream<Uint8Array>): AsyncGenerator<Message> {
  const reader = body.pipeThrough(new TextDecoderStream() as unknown as TransformStream<Uint8Array, string>).getReader();
  let rest = "";
  let message: Message = { id: null, event: "message", data: "" };
  try {
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      const lines = (rest + value).split(/\r\n|\n|\r/);
      rest = lines.pop() ?? "";
      for (const line of lines) {
        if (line === "") {
          if (message.data) yield message;
          message = { id: message.id, event: "message", data: "" };
          continue;
        }
        const colon = line.indexOf(":");
        if (colon === 0) continue;
        const name = colon < 0 ? line : line.slice(0, colon);
        const text = colon < 0 ? "" : line.slice(colon + 1).replace(/^ /, "");
        if (name === "data") message.data += (message.data ? "\n" : "") + text;
        else if (name === "event") message.event = text;
        else if (name === "id") message.id = text;
      }
    }
  } finally {
    reader.cancel().catch(() => undefined);
  }
}

/** Follow a job until it is final or `signal` fires; retryable errors do not end the loop. */
export async function follow(id: string, follower: Follower, signal: AbortSignal): Promise<void> {
  let streams = true;
  let lastId: string | null = null;
  let pause = 500;
  while (!signal.aborted) {
    try {
      const job = await getJob(id);
      if (signal.aborted) return;
      follower.onTrouble(null);
      follower.onJob(job);
      if (isFinal(job.status)) return;
      if (streams) {
        lastId = await listen(id, lastId, follower, signal);
        pause = 500;
      }
    } catch (error) {
      if (signal.aborted || isAbort(error)) return;
      if (!(error instanceof Refusal)) throw error;
      if (error.problem.code === "no_events") streams = false;
      else {
        follower.onTrouble(error);
        if (!error.problem.retryable) return;
        pause = Math.min(pause * 1.5, 5000);
      }
    }
    await sleep(pause, signal);
  }
}

async function listen(
  id: string,
  lastId: string | null,
  follower: Follower,
  signal: AbortSignal,
): Promise<string | null> {
  const headers: Record<string, string> = { Accept: "text/event-stream" };
  if (lastId !== null) headers["Last-Event-ID"] = lastId;
  let answer: Response;
  try {
    answer = await call(`v1/jobs/${encodeURIComponent(id)}/events`, { headers, signal });
  } catch (error) {
    if (error instanceof Refusal && [404, 405, 406, 501].includes(error.problem.status)) {
      throw new Refusal({ ...error.problem, code: "no_events" });
    }
    throw error;
  }
  if (!answer.body || !answer.headers.get("Content-Type")?.startsWith("text/event-stream")) return lastId;
  let last = lastId;
  try {
    for await (const message of messages(answer.body)) {
      last = message.id ?? last;
      const told = JSON.parse(message.data) as Partial<Job & Progress>;
      if (typeof told.status === "string" && typeof told.id === "string") follower.onJob(told as Job);
      else if (typeof told.stage === "string") follower.onProgress(told as Progress);
    }
  } catch (error) {
    // After an interrupted or unreadable stream, the loop fetches the record and reports an error only if that fails too.
    if (error instanceof DOMException) throw error;
  }
  return last;
}

function sleep(milliseconds: number, signal: AbortSignal): Promise<void> {
  return new Promise((resolve) => {
    const timer = setTimeout(resolve, milliseconds);
    signal.addEventListener("abort", () => {
      clearTimeout(timer);
      resolve();
    });
  });
}
