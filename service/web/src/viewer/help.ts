// The overlay with the viewer's keys and gestures.

import { button, h, uniqueId } from "../dom";

const KEYS: [string, string][] = [
  ["Drag, arrow keys", "rotate"],
  ["Wheel or pinch, + and −", "zoom (for the wheel, click the picture first)"],
  ["Right button or two fingers", "move"],
  ["Click or tap a point, Enter", "show its values (Enter: the point in the middle)"],
  ["Space", "play or pause"],
  [", and .", "one frame back and forward"],
  ["1, 2, 3", "front, side, top"],
  ["0", "fit the mesh to the picture"],
  ["C", "camera's view on and off"],
  ["F", "full screen"],
  ["?", "this help"],
];

/** Show the help inside `holder`, so that it is also visible in full screen; it is removed when closed. */
export function openHelp(holder: HTMLElement): void {
  if (holder.querySelector("dialog.help")) return;
  const title = uniqueId("help");
  const rows = KEYS.map(([keys, words]) => h("tr", {}, h("th", { scope: "row" }, keys), h("td", {}, words)));
  const dialog = h(
    "dialog",
    { class: "help", "aria-labelledby": title },
    h("h3", { id: title, tabindex: -1, autofocus: true }, "Keys and gestures"), // not the button, which may be below the window
    h("table", {}, h("tbody", {}, ...rows)),
    h("p", { class: "hint" }, "Keys work while the picture has the focus: click it, or press Tab until it is outlined."),
    button("Close", () => dialog.close(), { class: "primary" }),
  );
  dialog.addEventListener("close", () => dialog.remove());
  dialog.addEventListener("keydown", (event) => event.stopPropagation());
  holder.append(dialog);
  dialog.showModal();
}
