// The API: every operation with its parameters, bodies and answers, from the service's own description.

import * as auth from "../auth.js";
import { h } from "../dom.js";

const DESCRIPTION = "/openapi.json";
const FOR_OLDER_GENERATORS = "/openapi-3.0.json";

export async function mount(root) {
  const { default: showOperations } = await import("../../vendor/swagger-ui/swagger-ui.js");
  const place = h("div", { class: "operations" });
  root.append(
    h(
      "div",
      { class: "head" },
      h("h1", { class: "grow" }, "API"),
      h("a", { class: "button", href: DESCRIPTION, download: "openapi.json" }, "OpenAPI 3.1"),
      h("a", { class: "button", href: FOR_OLDER_GENERATORS, download: "openapi-3.0.json" }, "OpenAPI 3.0"),
    ),
    h("p", { class: "fine" }, "What is tried out here is done, with this tab's key."),
    place,
  );
  await new Promise((onComplete) => {
    showOperations({
      domNode: place,
      url: DESCRIPTION,
      docExpansion: "list",
      defaultModelsExpandDepth: 0,
      requestInterceptor: authorise,
      onComplete,
    });
  });
}

/** Give a request to this service the tab's key. */
function authorise(request) {
  if (new URL(request.url, location.href).origin === location.origin) Object.assign(request.headers, auth.headers());
  return request;
}
