// All calls to the service. URLs are relative, so that the page also works behind a proxy that adds a path.

import type { Inspection, Job, JobPage, Problem, Schema, Share } from "./types";

/** The service refused a request or did not answer: `problem.detail` is the message to show. */
export class Refusal extends Error {
  constructor(readonly problem: Problem) {
    super(problem.detail);
  }
}

const TOKEN = "pliant-token";

/** Send this bearer token with every request; it is kept until the tab is closed. */
export function setToken(token: string): void {
  if (token) sessionStorage.setItem(TOKEN, token);
  else sessionStorage.removeItem(TOKEN);
}

/** Whether a token is set. */
export function hasToken(): boolean {
  return sessionStorage.getItem(TOKEN) !== null;
}

/** The token of the share link that this page was opened with; it takes precedence over a stored token. */
let share: string | null = null;

/** Send the token of a share link with every request. */
export function setShare(token: string): void {
  share = token;
}

let single = false;

/** Show a single result: that of a share link, or of a folder on this computer. */
export function setSingle(): void {
  single = true;
}

/** Whether the page shows a single result, without a job list. */
export function isSingle(): boolean {
  return single;
}

/** Whether the page was opened with a share link. */
export function isShared(): boolean {
  return share !== null;
}

export function headers(): Record<string, string> {
  const token = share ?? sessionStorage.getItem(TOKEN);
  return token ? { Authorization: `Bearer ${token}` } : {};
}

function unreachable(advice = "Check that it is running; this page reconnects automatically."): Refusal {
  return new Refusal({
    title: "No answer",
    status: 0,
    detail: `The service does not answer. ${advice}`,
    code: "unreachable",
    retryable: true,
  });
}

/** Wait for the network; every failure but an abort means that the service does not answer. */
export async function reached<T>(waiting: Promise<T>): Promise<T> {
  try {
    return await waiting;
  } catch (error) {
    throw isAbort(error) ? error : unreachable();
  }
}

/** Return true for the error of a request that this page stopped. */
export function isAbort(error: unknown): boolean {
  return error instanceof DOMException && error.name === "AbortError";
}

/** Parse the body of a successful answer; a proxy's page or a body that was cut off may be followed by a better one. */
function parsed<T>(status: number, text: string): T {
  try {
    return JSON.parse(text) as T;
  } catch {
    const detail = "The service's answer cannot be read: something between it and this page has changed it. Check the address and the proxy.";
    throw new Refusal({ title: "Unreadable answer", status, detail, code: "unknown", retryable: true });
  }
}

/** Parse problem+json, or describe a response in another format as a problem. */
function problemOf(status: number, text: string): Problem {
  try {
    const given = JSON.parse(text) as Partial<Problem>;
    if (typeof given.detail === "string") {
      return { title: "Refused", status, code: "unknown", ...given, detail: given.detail };
    }
  } catch {
    // Not JSON: a proxy's page, or an empty body. Only the status is known.
  }
  // A service that ends, or a proxy while the service restarts or is busy, answers so.
  const retryable = status >= 500 || status === 408 || status === 429;
  return {
    title: "Refused",
    status,
    detail: `The service answered with status ${status} and no explanation. ${retryable ? "It may be starting, ending or busy: try again in a moment. " : ""}Its log has details.`,
    code: "unknown",
    retryable,
  };
}

export async function call(path: string, init: RequestInit = {}): Promise<Response> {
  const answer = await reached(fetch(path, { ...init, headers: { ...headers(), ...(init.headers as Record<string, string>) } }));
  if (!answer.ok) throw new Refusal(problemOf(answer.status, await reached(answer.text())));
  return answer;
}

async function json<T>(path: string, init?: RequestInit): Promise<T> {
  const answer = await call(path, init);
  return parsed<T>(answer.status, await reached(answer.text()));
}

const at = (id: string): string => `v1/jobs/${encodeURIComponent(id)}`;

export const getJob = (id: string): Promise<Job> => json(at(id));
export const listJobs = (cursor?: string | null): Promise<JobPage> =>
  json(`v1/jobs?limit=25${cursor ? `&cursor=${encodeURIComponent(cursor)}` : ""}`);
export const cancelJob = (id: string): Promise<Job> => json(`${at(id)}/cancel`, { method: "POST" });
export const retryJob = (id: string): Promise<Job> => json(`${at(id)}/retry`, { method: "POST" });
const posted = (body: unknown): RequestInit => ({
  method: "POST",
  headers: { "Content-Type": "application/json" },
  body: JSON.stringify(body),
});
/** Request more files of a result; return the job that writes them. */
export const makeOutputs = (id: string, wanted: Record<string, unknown>): Promise<Job> => json(`${at(id)}/outputs`, posted(wanted));
export const createShare = (id: string, seconds: number): Promise<Share> => json(`${at(id)}/shares`, posted({ expires_in: seconds }));
export const listShares = (id: string): Promise<Share[]> => json(`${at(id)}/shares`);
export const revokeShare = async (id: string, shareId: string): Promise<void> => {
  await call(`${at(id)}/shares/${encodeURIComponent(shareId)}`, { method: "DELETE" });
};
export const deleteJob = async (id: string): Promise<void> => {
  await call(at(id), { method: "DELETE" });
};

/** Return how the service interprets files, without creating a job. */
export const inspect = (form: FormData, signal: AbortSignal): Promise<Inspection> =>
  json("v1/inspect", { method: "POST", body: form, signal });

let options: Promise<Schema> | null = null;

/** Return the schema of the options; it is fetched once. */
export function getOptions(): Promise<Schema> {
  options ??= json<Schema>("v1/options").catch((error: unknown) => {
    options = null;
    throw error;
  });
  return options;
}

export const artifactPath = (id: string, name: string): string => `${at(id)}/artifacts/${encodeURIComponent(name)}`;
export const getReport = (id: string): Promise<Record<string, unknown>> => json(artifactPath(id, "report.json"));

export interface Example {
  name: string;
  title: string;
  files: { part: string; file: string }[];
  /** Region to track in a film: corners in its first frame. */
  region_polygon?: [number, number][] | null;
}
export const listExamples = (): Promise<{ examples: Example[] }> => json("v1/examples");

export async function exampleFile(name: string, file: string): Promise<File> {
  const answer = await call(`v1/examples/${encodeURIComponent(name)}/${encodeURIComponent(file)}`);
  return new File([await reached(answer.blob())], file);
}

/** A new idempotency key, by which the service recognises a repeated submission. */
export function newKey(): string {
  return Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** Submit a new job. Uses XMLHttpRequest, because fetch does not report upload progress. */
export async function submit(form: FormData, key: string, onSent: (fraction: number) => void, signal: AbortSignal): Promise<Job> {
  const request = new XMLHttpRequest();
  await new Promise<void>((resolve, reject) => {
    request.open("POST", "v1/jobs");
    for (const [name, value] of Object.entries(headers())) request.setRequestHeader(name, value);
    request.setRequestHeader("Accept", "application/json");
    request.setRequestHeader("Idempotency-Key", key);
    request.upload.onprogress = (event) => {
      if (event.lengthComputable) onSent(event.loaded / event.total);
    };
    request.onload = () => resolve();
    request.onerror = () => reject(unreachable("Check that it is running, then press Reconstruct again; no job is created twice."));
    request.onabort = () => reject(new DOMException("The upload was stopped.", "AbortError"));
    signal.addEventListener("abort", () => request.abort());
    request.send(form);
  });
  if (request.status < 200 || request.status >= 300) throw new Refusal(problemOf(request.status, request.responseText));
  return parsed<Job>(request.status, request.responseText);
}
