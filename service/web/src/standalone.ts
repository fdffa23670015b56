// The viewer in a self-contained page, as saved by the button "HTML page": the files are embedded in base64.

import { Viewer } from "./viewer/viewer";

function address(id: string): string | undefined {
  const text = document.getElementById(id)?.textContent;
  if (!text) return undefined;
  const raw = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return URL.createObjectURL(new Blob([raw]));
}

const stage = document.getElementById("stage") as HTMLElement;
const preview = address("preview");
if (preview === undefined) stage.textContent = "This file is incomplete: save it again.";
else {
  Viewer.open(stage, { title: document.title, preview, film: address("film") }, new AbortController().signal).catch((error: unknown) => {
    stage.textContent = `The mesh cannot be displayed here (${error instanceof Error ? error.message : String(error)}).`;
  });
}
