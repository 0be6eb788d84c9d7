"""Clients that others' generators make of the API's description: they accept it, and it compiles.

The generators are of npm (``tests/contract/generators``) and of PyPI, where OpenAPI Generator is a
Java archive. A test is skipped, with the reason, where its generator or compiler is missing.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from service.settings import Settings
from solver.cache import cache_directory

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
LOCK = Path(__file__).parent / "generators"
GENERATOR = "openapi-generator-cli==7.26.0"
INSTALL_TIMEOUT_S = 300
RUN_TIMEOUT_S = 300
VALIDATE = """
const { default: parser } = await import("@apidevtools/swagger-parser");
await parser.validate(process.argv[1]);
"""
ASSEMBLIES = (
    *("System.Net.Http", "System.Runtime.Serialization", "System.Xml", "System.Xml.Linq"),
    "System.ComponentModel.DataAnnotations",
)
NEWTONSOFT = Path("/usr/lib/cli/Newtonsoft.Json-5.0/Newtonsoft.Json.dll")


@pytest.fixture(scope="module")
def documents(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Give a folder with both descriptions, as a service sends them."""
    folder = tmp_path_factory.mktemp("openapi")
    with TestClient(create_app(Settings(data_dir=folder)), base_url="http://127.0.0.1") as http:
        for name in ("openapi.json", "openapi-3.0.json"):
            (folder / name).write_bytes(http.get(f"/{name}").content)
    return folder


@pytest.fixture(scope="module")
def node() -> Path:
    """Return a folder with the generators of npm."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("the generators need npm (apt-get install npm)")
    cache = cache_directory() / "generators"
    if not (cache / "node_modules" / "typescript").exists():
        shutil.copytree(LOCK, cache, dirs_exist_ok=True)
        install([npm, "ci", "--silent", "--no-audit", "--no-fund"], cache)
    return cache


@pytest.fixture(scope="module")
def generate() -> list[str]:
    """Return the command of OpenAPI Generator."""
    java = shutil.which("java")
    if java is None:
        pytest.skip("OpenAPI Generator needs Java (apt-get install default-jre-headless)")
    cache = cache_directory() / "openapi-generator"
    if not list(cache.rglob("*.jar")):
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target"]
        install([*pip, str(cache), GENERATOR], ROOT)
    return [java, "-jar", str(next(cache.rglob("*.jar")))]


def install(command: list[str], folder: Path) -> None:
    try:
        subprocess.run(command, cwd=folder, check=True, timeout=INSTALL_TIMEOUT_S)
    except (subprocess.SubprocessError, OSError) as error:
        pytest.skip(f"{command[0]} could not install the generators: {error}")


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command to its end and return what it said."""
    done = subprocess.run(
        list(map(str, command)),
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=RUN_TIMEOUT_S,
        check=False,
    )
    said = done.stdout + done.stderr
    assert done.returncode == 0, said[-3000:]
    return said


def mono(name: str) -> str:
    found = shutil.which(name)
    if found is None or not NEWTONSOFT.exists():
        pytest.skip(
            "there is no C# compiler (apt-get install mono-mcs mono-runtime libmono-cil-dev "
            "libnewtonsoft-json5.0-cil)"
        )
    return found


def test_the_older_description_is_openapi_3_0(documents: Path, node: Path) -> None:
    run("node", "--input-type=module", "-e", VALIDATE, documents / "openapi-3.0.json", cwd=node)


@pytest.mark.parametrize("name", ["openapi.json", "openapi-3.0.json"])
def test_types_of_typescript_compile(
    name: str, documents: Path, node: Path, tmp_path: Path
) -> None:
    types = tmp_path / "api.d.ts"
    programs = node / "node_modules" / ".bin"
    run(programs / "openapi-typescript", documents / name, "-o", types, cwd=node)
    use = tmp_path / "use.ts"
    use.write_text(
        'import type { operations, components } from "./api";\n'
        'export const role: components["schemas"]["NewCapture"]["role"] = "neutral";\n'
        'type Body = operations["subjects.change"]["requestBody"]["content"];\n'
        'type Change = Body["application/json"];\n'
        'export const change: Change = { labels: { session: "17", draft: null } };\n'
        'export const done = (job: components["schemas"]["JobItem"]) => job.result?.verdict;\n'
    )
    run(programs / "tsc", "--noEmit", "--strict", use, cwd=tmp_path)


def test_a_client_in_typescript_compiles(
    documents: Path, node: Path, generate: list[str], tmp_path: Path
) -> None:
    given = ("-i", documents / "openapi-3.0.json", "-g", "typescript-fetch", "-o", tmp_path / "ts")
    said = run(*generate, "generate", *given, cwd=tmp_path)
    assert "WARN" not in said
    made = (tmp_path / "ts" / "apis" / "SubjectsApi.ts").read_text()
    assert "async subjectsCreate(" in made
    tsc = node / "node_modules" / ".bin" / "tsc"
    how = ("--noEmit", "--strict", "--target", "es2022", "--moduleResolution", "bundler")
    run(tsc, *how, "--module", "es2022", "--lib", "es2022,dom", "ts/index.ts", cwd=tmp_path)


def test_a_client_in_c_sharp_compiles(documents: Path, generate: list[str], tmp_path: Path) -> None:
    given = ("-i", documents / "openapi-3.0.json", "-g", "csharp", "-o", tmp_path / "cs")
    wanted = "packageName=Myoface,library=httpclient,targetFramework=net48"
    said = run(*generate, "generate", *given, f"--additional-properties={wanted}", cwd=tmp_path)
    assert "WARN" not in said
    made = tmp_path / "cs" / "src" / "Myoface"
    assert "SubjectsCreate(" in (made / "Api" / "SubjectsApi.cs").read_text()
    # The calls need a newer Newtonsoft.Json than Debian's, and Polly; the values do not.
    client = [made / "Client" / f"{name}.cs" for name in ("OpenAPIDateConverter", "FileParameter")]
    sources = [*sorted((made / "Model").glob("*.cs")), *client]
    of_calls = {f"{name}.cs" for name in ("AbstractOpenAPISchema", "FramesInner", "FramesView")}
    sources = [each for each in sources if each.name not in of_calls]
    assert len(sources) > 70
    references = [f"-r:{name}.dll" for name in ASSEMBLIES] + [f"-r:{NEWTONSOFT}"]
    how = ("-target:library", "-langversion:latest", "-out:made.dll")
    run(mono("mcs"), *how, *references, *sources, cwd=tmp_path)


def test_the_station_in_c_sharp_is_compiled_by_what_windows_has(tmp_path: Path) -> None:
    station = ROOT / "docs" / "examples" / "station.cs"
    references = [f"-r:{name}.dll" for name in ASSEMBLIES]
    how = ("-langversion:5", "-out:station.exe", "-warnaserror")
    run(mono("mcs"), *how, *references, station, cwd=tmp_path)
    assert len(station.read_text().splitlines()) < 190


def test_the_station_in_powershell_is_read() -> None:
    tree_sitter = pytest.importorskip("tree_sitter")
    grammar = pytest.importorskip("tree_sitter_powershell")
    parser = tree_sitter.Parser(tree_sitter.Language(grammar.language()))
    source = (ROOT / "docs" / "examples" / "station.ps1").read_bytes()
    assert source.isascii()  # 5.1 takes a file without a mark for one of the code page
    assert not parser.parse(source).root_node.has_error
