// What a visitor of a share link sees: one result, how long it can be seen, and a sentence once it cannot.

import { Refusal, listShares, setShare } from "./api";
import { h, say } from "./dom";

const LONGEST_WAIT = 2 ** 31 - 1; // of setTimeout, milliseconds

/** The token of the share link in the address, null without one. */
export function sharedToken(): string | null {
  return new URLSearchParams(location.hash.slice(1)).get("share");
}

/** The job of a share link's token. */
function sharedJob(token: string): string {
  return token.slice(token.indexOf(".") + 1, token.lastIndexOf("."));
}

/** Show the result that a share link opens through `show`, with a note above it; or, in `place`, why it shows nothing. */
export async function openShared(token: string, place: HTMLElement, show: (id: string, note: HTMLElement) => void): Promise<void> {
  setShare(token);
  const id = sharedJob(token);
  const until = h("span", { class: "until" });
  const note = h("p", { class: "shared-note", role: "status" }, "You see a shared result, read-only. ", until);
  try {
    const [link] = await listShares(id);
    if (link) tell(until, new Date(link.expires_at));
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    const ended = sentence(error);
    if (ended !== null) {
      document.title = "Shared result – Pliant";
      place.append(h("section", { class: "shared-note", role: "status" }, h("h2", {}, "This result can no longer be seen"), h("p", {}, ended)));
      return;
    }
  }
  show(id, note);
}

/** State the end of the link now, and that it has ended when it has. */
function tell(place: HTMLElement, end: Date): void {
  const left = end.getTime() - Date.now();
  if (left > 0) {
    say(place, `The link is valid until ${moment(end)}.`);
    setTimeout(() => tell(place, end), Math.min(left, LONGEST_WAIT));
  } else {
    say(place, `The link expired on ${moment(end)}: what is shown stays until you close or reload this page. For more, ask its sender for a new link.`);
  }
}

/** Why a link shows nothing, null where the reason is another one than the link. */
function sentence({ problem }: Refusal): string | null {
  const end = new Date(problem.got ?? "");
  if (problem.code === "expired_share") {
    return `The link expired${Number.isNaN(end.getTime()) ? "" : ` on ${moment(end)}`}. Ask its sender for a new one.`;
  }
  return problem.code === "invalid_share" ? problem.detail : null;
}

/** A date and time as the visitor writes it. */
function moment(date: Date): string {
  return date.toLocaleString(undefined, { dateStyle: "long", timeStyle: "short" });
}
