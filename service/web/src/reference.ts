// The API reference: Swagger UI, bundled with the page because the content security policy forbids a CDN.

import SwaggerUI from "swagger-ui-dist/swagger-ui-bundle.js";
import "swagger-ui-dist/swagger-ui.css";
import "./readable.css";

/** Add what Swagger UI lacks: labels for the server list and the regions, and heading levels for tags and schemas. */
function nameParts(): void {
  document.querySelector("#servers")?.setAttribute("aria-label", "Server");
  for (const [part, label] of [[".information-container", "About"], [".scheme-container", "Server and access"]] as const) {
    const found = document.querySelector(part);
    found?.setAttribute("role", "region");
    found?.setAttribute("aria-label", label);
  }
  for (const tag of document.querySelectorAll(".opblock-tag, section.models h4")) tag.setAttribute("aria-level", "2");
}

SwaggerUI({
  url: "openapi.json",
  dom_id: "#reference",
  deepLinking: true,
  validatorUrl: null, // would send the document to another host
  onComplete: nameParts,
});
