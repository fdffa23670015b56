// Links to files of a job that also work if the request needs a token.

import { call, headers, reached } from "./api";
import { h } from "./dom";
import { explained } from "./refusal";

/** A link that phones and headsets open in AR Quick Look; null if the browser does not support it. */
export function quickLookLink(path: string, words: string): HTMLAnchorElement | null {
  if (!document.createElement("a").relList.supports("ar")) return null;
  // Quick Look handles the link only if it contains a picture and nothing else.
  const icon = document.querySelector<HTMLLinkElement>("link[rel=icon]")?.href;
  const link = h("a", { href: path, rel: "ar", class: "button" }, h("img", { src: icon, alt: words, width: 24, height: 24 }));
  link.addEventListener("click", (event) => {
    if (!("Authorization" in headers()) || link.href.startsWith("blob:")) return;
    event.preventDefault(); // a plain link cannot carry the token
    void explained(link, () => openWithToken(link, path));
  });
  return link;
}

/** Fetch the target of a link with the token, then open that copy. */
async function openWithToken(link: HTMLAnchorElement, path: string): Promise<void> {
  link.href = URL.createObjectURL(await contentOf(path));
  link.click();
}

/** Fetch the target of a link with the token, then save that copy. */
export function saveWithToken(link: HTMLAnchorElement, path: string, name: string): Promise<void> {
  return explained(link, async () => {
    const url = URL.createObjectURL(await contentOf(path));
    h("a", { href: url, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(url), 60_000);
  });
}

async function contentOf(path: string): Promise<Blob> {
  return reached((await call(path)).blob());
}
