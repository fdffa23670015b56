// Links to files of a job, for browsers that must send a token with the request, too.

import { call, headers } from "./api";
import { h } from "./dom";

/** A link that phones and headsets open in their own viewer (AR Quick Look); null where the browser has none. */
export function quickLookLink(path: string, words: string): HTMLAnchorElement | null {
  if (!document.createElement("a").relList.supports("ar")) return null;
  // Quick Look takes the link over only if it holds a picture and nothing else.
  const link = h("a", { href: path, rel: "ar", class: "button" }, h("img", { src: "page/icon.svg", alt: words, width: 24, height: 24 }));
  link.addEventListener("click", (event) => {
    if (!("Authorization" in headers()) || link.href.startsWith("blob:")) return;
    event.preventDefault(); // a plain link cannot carry the token
    void openWithToken(link, path);
  });
  return link;
}

/** Fetch what a link names, then follow it to that copy. */
async function openWithToken(link: HTMLAnchorElement, path: string): Promise<void> {
  link.href = URL.createObjectURL(await (await call(path)).blob());
  link.click();
}

export async function saveWithToken(path: string, name: string): Promise<void> {
  const url = URL.createObjectURL(await (await call(path)).blob());
  h("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}
