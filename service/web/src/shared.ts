// The page of a share link: one result and the expiry of the link, or why the link is not valid.

import { Refusal, listShares, setShare } from "./api";
import { h, say } from "./dom";

const LONGEST_WAIT = 2 ** 31 - 1; // of setTimeout, milliseconds

/** The token of the share link in the address, null without one. */
export function sharedToken(): string | null {
  return new URLSearchParams(location.hash.slice(1)).get("share");
}

/** The job id in the token of a share link. */
function sharedJob(token: string): string {
  return token.slice(token.indexOf(".") + 1, token.lastIndexOf("."));
}

/** Call `show` with the result of a share link and a note to place above it; or explain in `place` why there is none. */
export async function openShared(token: string, place: HTMLElement, show: (id: string, note: HTMLElement) => void): Promise<void> {
  setShare(token);
  const id = sharedJob(token);
  const until = h("span", { class: "until" });
  const note = h("p", { class: "shared-note", role: "status" }, "This is a shared, read-only result. ", until);
  try {
    const [link] = await listShares(id);
    if (link) tell(until, new Date(link.expires_at));
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    const ended = sentence(error);
    if (ended !== null) {
      document.title = "Shared result – Pliant";
      place.append(h("section", { class: "shared-note", role: "status" }, h("h2", {}, "This result is no longer available"), h("p", {}, ended)));
      return;
    }
  }
  show(id, note);
}

/** Show when the link expires, and later that it has expired. */
function tell(place: HTMLElement, end: Date): void {
  const left = end.getTime() - Date.now();
  if (left > 0) {
    say(place, `The link is valid until ${moment(end)}.`);
    setTimeout(() => tell(place, end), Math.min(left, LONGEST_WAIT));
  } else {
    say(place, `The link expired on ${moment(end)}. This result stays visible until you close or reload the page. Ask its sender for a new link.`);
  }
}

/** Why a link is not valid; null if the error has another cause. */
function sentence({ problem }: Refusal): string | null {
  const end = new Date(problem.got ?? "");
  if (problem.code === "expired_share") {
    return `The link expired${Number.isNaN(end.getTime()) ? "" : ` on ${moment(end)}`}. Ask its sender for a new one.`;
  }
  return problem.code === "invalid_share" ? problem.detail : null;
}

/** A date and time in the visitor's locale. */
function moment(date: Date): string {
  return date.toLocaleString(undefined, { dateStyle: "long", timeStyle: "short" });
}
