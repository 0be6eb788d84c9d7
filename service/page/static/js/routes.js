// The views by path. `service/page/routes.py` serves the document at the same paths.
//
// A view module exports
//
//     export async function mount(root, params, query) -> dispose
//
// `root` is an empty element in the page, `params` holds what `:name` stands for in the path and
// `query` is the address's URLSearchParams. `mount` fills `root`; if it throws, the page says why
// and offers to try again. `dispose()` (or nothing) is called once before the next view mounts: it
// ends streams, timers and listeners beyond `root`. A change of path or query by a link mounts anew.
// A route's `style` is a style sheet of its own, there before its view mounts.

const RIG_STYLE = "/static/css/rig.css";
const API_STYLE = "/static/vendor/swagger-ui/swagger-ui.css";

const ROUTES = [
  { path: "/", title: "Queue", load: () => import("./views/queue.js") },
  { path: "/queue", title: "Queue", load: () => import("./views/queue.js") },
  { path: "/upload", title: "Upload", load: () => import("./views/upload.js") },
  { path: "/subjects", title: "Subjects", load: () => import("./views/subjects.js") },
  { path: "/subjects/:id", title: "Subject", load: () => import("./views/subject.js") },
  { path: "/jobs", title: "Queue", load: () => import("./views/queue.js") },
  { path: "/jobs/:id", title: "Job", style: RIG_STYLE, load: () => import("./views/job.js") },
  { path: "/rigs", title: "Rigs", load: () => import("./views/rigs.js") },
  { path: "/rigs/:id", title: "Rig", style: RIG_STYLE, load: () => import("./views/rig.js") },
  { path: "/markers/:id", title: "Markers", style: RIG_STYLE, load: () => import("./views/markers.js") },
  { path: "/compare", title: "Compare", style: RIG_STYLE, load: () => import("./views/compare.js") },
  { path: "/health", title: "Health", load: () => import("./views/health.js") },
  { path: "/webhooks", title: "Webhooks", load: () => import("./views/webhooks.js") },
  { path: "/webhooks/:id", title: "Webhook", load: () => import("./views/webhook.js") },
  { path: "/audit", title: "Audit log", load: () => import("./views/audit.js") },
  { path: "/api", title: "API", style: API_STYLE, load: () => import("./views/api.js") },
  { path: "/sign-in", title: "Sign in", load: () => import("./views/sign_in.js") },
];

/** Return the route of a path with its parameters, or null. */
export function match(pathname) {
  for (const route of ROUTES) {
    const names = [];
    const pattern = route.path.replace(/:(\w+)/g, (_, name) => {
      names.push(name);
      return "([^/]+)";
    });
    const found = new RegExp(`^${pattern}/?$`).exec(pathname);
    if (found) {
      const values = found.slice(1).map(decoded);
      return { route, params: Object.fromEntries(names.map((name, i) => [name, values[i]])) };
    }
  }
  return null;
}

function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text; // cut off within a character: no id, whatever it was
  }
}
