// Links to files of a job, for browsers that must send a token with the request, too.

import { call, headers } from "./api";
import { h } from "./dom";

/** A link that phones and headsets open in their own viewer (AR Quick Look), and that others save. */
export function artifactLink(path: string, words: string): HTMLAnchorElement {
  // Quick Look takes the link over only if it holds a picture and nothing else.
  const quick = document.createElement("a").relList.supports("ar");
  const name = decodeURIComponent(path.split("/").at(-1) ?? "");
  const content = quick ? h("img", { src: "page/icon.svg", alt: words, width: 24, height: 24 }) : words;
  const link = h("a", { href: path, rel: "ar", class: "button", download: quick ? null : name }, content);
  link.addEventListener("click", (event) => {
    if (!("Authorization" in headers())) return;
    event.preventDefault(); // a plain link cannot carry the token
    void saveWithToken(path, name);
  });
  return link;
}

export async function saveWithToken(path: string, name: string): Promise<void> {
  const url = URL.createObjectURL(await (await call(path)).blob());
  h("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}
