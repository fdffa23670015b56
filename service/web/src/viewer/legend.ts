// The legend of the colours below the picture.

import { fill, h } from "../dom";
import type { Values } from "./colours";

/** Show the legend of these values; null hides it. */
export function showLegend(legend: HTMLElement, values: Values | null): void {
  legend.hidden = values === null;
  fill(legend, JSON.stringify(values), () =>
    values === null
      ? []
      : [
          h("span", {}, `${values.words}: ${values.low}`),
          h("span", { class: values.low === "0" ? "ramp" : "ramp diverging" }),
          h("span", {}, values.high),
          values.hasUnknown && h("span", { class: "key-unknown" }, `grey: ${values.unknown ?? "hidden"}`),
        ],
  );
}
