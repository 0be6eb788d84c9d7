"""What the service hands to a browser: only its own files, under strict rules."""

import gzip
import hashlib
import json
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from service.page.routes import PATHS, POLICY, TYPES
from service.settings import Settings
from solver.drawing.head import HEAT

STATIC = Path(__file__).parents[2] / "service" / "page" / "static"
VENDOR = STATIC / "vendor"
OWN = [path for path in STATIC.rglob("*") if path.is_file() and VENDOR not in path.parents]
SCRIPTS = [path for path in OWN if path.suffix == ".js"]
NAMESPACES = ("http://www.w3.org/2000/svg",)


@pytest.fixture(scope="module")
def http(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("page"))
    with TestClient(create_app(settings), base_url="http://127.0.0.1") as client:
        yield client


class _Tags(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def _tags() -> list[tuple[str, dict[str, str | None]]]:
    parser = _Tags()
    parser.feed((STATIC / "index.html").read_text())
    return parser.found


def test_the_document_has_no_inline_script_or_style() -> None:
    for tag, attributes in _tags():
        assert tag != "style"
        assert not any(name == "style" or name.startswith("on") for name in attributes), tag
        if tag == "script":
            assert attributes.get("src"), "an inline script"


def test_what_the_document_asks_for_is_there() -> None:
    asked = [attributes.get("src") or attributes.get("href") for _, attributes in _tags()]
    static = [path for path in asked if path and path.startswith("/static/")]
    assert len(static) >= 5
    for path in static:
        assert (STATIC / path.removeprefix("/static/")).is_file(), path


@pytest.mark.parametrize("path", OWN, ids=lambda path: path.relative_to(STATIC).as_posix())
def test_no_foreign_address(path: Path) -> None:
    text = path.read_text()
    for namespace in NAMESPACES:
        text = text.replace(namespace, "")
    assert not re.search(r"""(https?:)?//[a-z0-9-]+\.[a-z]""", _without_comments(text)), path
    assert "@import" not in text


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.relative_to(STATIC).as_posix())
def test_scripts_set_text_never_markup(path: Path) -> None:
    code = _without_comments(path.read_text())
    for forbidden in (
        r"\binnerHTML\b",
        r"\bouterHTML\b",
        r"\binsertAdjacentHTML\b",
        r"\bdocument\.write\b",
        r"\beval\(",
        r"\bnew Function\b",
        r"\bDOMParser\b",
        r"setAttribute\(.style",
    ):
        assert not re.search(forbidden, code), (path.name, forbidden)


def _imports(path: Path) -> list[str]:
    imports = r'^(?:import|export)\b[^;]*?from "([^"]+)";|\bimport\("([^"]+)"\)'
    found = re.findall(imports, path.read_text(), flags=re.MULTILINE)
    return [static or lazy for static, lazy in found]


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.relative_to(STATIC).as_posix())
def test_imports_lead_somewhere(path: Path) -> None:
    for name in _imports(path):
        assert name.startswith("."), f"{path.name} imports the bare {name}"
        assert (path.parent / name).resolve().is_file(), f"{path.name}: {name}"


def test_imports_make_no_circle() -> None:
    leads = {path: {(path.parent / name).resolve() for name in _imports(path)} for path in SCRIPTS}
    done: set[Path] = set()

    def visit(path: Path, way: tuple[Path, ...]) -> None:
        assert path not in way, " -> ".join(each.name for each in (*way, path))
        if path not in done:
            for other in leads.get(path, ()):
                visit(other, (*way, path))
            done.add(path)

    for path in SCRIPTS:
        visit(path, ())


@pytest.mark.parametrize("path", OWN, ids=lambda path: path.relative_to(STATIC).as_posix())
def test_every_file_is_of_a_kind_that_is_served_and_of_a_size_to_read(path: Path) -> None:
    assert path.suffix in TYPES
    assert len(path.read_text().splitlines()) <= 400


def test_the_server_and_the_router_know_the_same_paths() -> None:
    routes = (STATIC / "js" / "routes.js").read_text()
    shown = set(re.findall(r'\{ path: "([^"]+)"', routes))
    assert shown == {re.sub(r"\{\w+\}", ":id", path) for path in PATHS}


def test_the_page_and_the_reports_have_one_scale_of_heat() -> None:
    colours = (STATIC / "js" / "rig" / "colours.js").read_text()
    (table,) = re.findall(r"const HEAT = (\[.*?\n\]);", colours, flags=re.DOTALL)
    assert json.loads(re.sub(r",(\s*\])", r"\1", table)) == HEAT.tolist()


def test_it_is_served_at_its_paths_under_a_strict_policy(http: TestClient) -> None:
    for path in PATHS:
        answer = http.get(path.format(identifier="8c1d3a52-0f4e-4c5b-9b39-1f3a4f1f6c11"))
        assert answer.status_code == 200
        assert answer.headers["content-type"] == "text/html; charset=utf-8"
        assert answer.headers["content-security-policy"] == POLICY
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert "unsafe" not in POLICY
        assert answer.text == (STATIC / "index.html").read_text()


def test_files_are_packed_and_asked_for_again_only_by_tag(http: TestClient) -> None:
    path = "/static/js/main.js"
    plain = http.get(path, headers={"Accept-Encoding": "identity"})
    with http.stream("GET", path, headers={"Accept-Encoding": "br, gzip;q=0.8"}) as packed:
        body = b"".join(packed.iter_raw())
    assert plain.headers["content-type"] == "text/javascript; charset=utf-8"
    assert packed.headers["content-encoding"] == "gzip"
    assert gzip.decompress(body) == plain.content == (STATIC / "js" / "main.js").read_bytes()
    assert plain.headers["etag"] != packed.headers["etag"]
    assert hashlib.sha256(plain.content).hexdigest()[:32] in plain.headers["etag"]
    for answer, encoding in ((plain, "identity"), (packed, "gzip")):
        tag = answer.headers["etag"]
        headers = {"Accept-Encoding": encoding, "If-None-Match": f'"other", W/{tag}'}
        again = http.get(path, headers=headers)
        assert (again.status_code, again.content) == (304, b"")
        assert again.headers["etag"] == tag
    head = http.head(path)
    assert (head.status_code, head.content) == (200, b"")


@pytest.mark.parametrize(
    "path", ["nothing.js", "../routes.py", "%2e%2e/routes.py", "..%2froutes.py", "js", "js/", ""]
)
def test_nothing_else_is_served(path: str, http: TestClient) -> None:
    answer = http.get(f"/static/{path}")
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"


def test_the_page_is_not_part_of_the_api_description(http: TestClient) -> None:
    paths = http.get("/openapi.json").json()["paths"]
    assert not [path for path in paths if path in PATHS or path.startswith("/static")]


def _without_comments(text: str) -> str:
    text = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    return re.sub(r"(^|\s)//[^\n]*", "", text)
