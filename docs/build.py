"""Build the documentation site: `python -m pip install ".[docs]" && python docs/build.py`.

It goes to build/site/html. Pages of docs, benchmarks/results and notebooks are taken where they
are; notebooks are executed, and the API is made of docstrings. The folder that the variable
FRACTALJAX_EXECUTED names keeps executed notebooks, which are taken while their cells are the same.
"""

import ast
import base64
import concurrent.futures
import html.parser
import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote, urldefrag

import nbclient
import nbformat

ROOT = Path(__file__).resolve().parents[1]
SITE = ROOT / "build" / "site"
SOURCE, HTML = SITE / "src", SITE / "html"
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
GROUPS = {  # of the API: title, and the modules whose public names it has
    "surface": ("Surfaces", ("_surface",)),
    "contact": ("Contact", ("_contact",)),
    "friction": ("Friction", ("_friction", "_friction_memory", "_tabulated_friction")),
    "mechanism": ("Scenes and structures", ("_mechanism",)),
    "stability": ("Stability", ("_stability",)),
    "dynamics": ("Motion and limit cycles", ("_dynamics",)),
    "design": ("Design", ("_design",)),
    "identify": ("Identification", ("_identify",)),
    "sweep": ("Sweeps", ("_sweep",)),
    "validate": ("Validation", ("_validate",)),
    "plot": ("Pictures", ("plot",)),
}


def main() -> int:
    """Stage the pages, build, set equations, check links; 0 if nothing is wrong."""
    shutil.rmtree(SITE, ignore_errors=True)
    SOURCE.mkdir(parents=True)
    stage_pages()
    stage_notebooks()
    stage_api()
    stage_explore()
    stage_gallery()
    settings()
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    output: dict = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    done = subprocess.run(command, cwd=SITE, text=True, **output)
    said = re.sub(r"\x1b\[[0-9;]*m", "", done.stdout)  # without colours
    if done.returncode or re.search("(?i)warn|error", said):  # not every error fails it
        print(said, file=sys.stderr)
        return 1
    pages = sorted(HTML.rglob("*.html"))
    for page in pages:
        page.write_text(with_equations(page.read_text(encoding="utf-8")), encoding="utf-8")
    broken = broken_links(HTML)
    print("\n".join(broken) or f"{len(pages)} pages in {HTML}", file=sys.stderr)
    return bool(broken)


# --- pages ----------------------------------------------------------------------------------


def stage_pages() -> None:
    """The pages of the repository under their own paths, a README as the index of its folder."""
    put(ROOT / "README.md", "index.md")
    put(ROOT / "notebooks" / "README.md", "notebooks/index.md")
    for path in (ROOT / "docs").iterdir():
        if path.suffix in (".md", ".png"):
            put(path, f"docs/{path.name}")
    for path in (ROOT / "benchmarks" / "results").iterdir():
        if path.suffix in (".md", ".png"):
            name = path.name.replace("README", "index")
            put(path, f"benchmarks/results/{name}")
    for path in (ROOT / "docs" / "site").rglob("*.*"):
        if path.suffix in (".md", ".css"):
            put(path, str(path.relative_to(ROOT / "docs" / "site")))
    font = "STIXTwoMath-Regular.ttf"  # that has what equations need; few machines have one
    (found,) = [path for path in importlib.metadata.files("ziamath") or () if path.name == font]
    shutil.copy(str(found.locate()), SOURCE / font)


def put(path: Path, name: str) -> None:
    target = SOURCE / name
    target.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix != ".md":
        shutil.copy(path, target)
        return
    text = path.read_text(encoding="utf-8")
    for link in set(re.findall(r"\]\(([^)#:]+)\)", text)):
        aim = path.parent / link
        if aim.is_file() and aim.suffix not in (".md", ".png", ".ipynb", ".html"):
            shutil.copy(aim, target.parent / aim.name)  # a file to read, such as CITATION.cff
    text = re.sub(r"(\]\([^)]*)README\.md", r"\1index.md", text).replace("](docs/site/", "](")
    target.write_text(re.sub(r"(\]\([^):]*)\.ipynb", r"\1.md", text), encoding="utf-8")


# --- notebooks ------------------------------------------------------------------------------


def stage_notebooks() -> None:
    """Executed, two at a time: each is a process of its own."""
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        for path, notebook in zip(NOTEBOOKS, pool.map(executed, NOTEBOOKS), strict=True):
            target = SOURCE / "notebooks" / path.with_suffix(".md").name
            target.write_text(as_markdown(notebook, target), encoding="utf-8")


def executed(path: Path) -> nbformat.NotebookNode:
    """A notebook with its outputs: kept ones, if its cells are the same, or new ones."""
    wanted = nbformat.read(path, as_version=4)
    folder = os.environ.get("FRACTALJAX_EXECUTED")
    kept = Path(folder) / path.name if folder else None
    if kept is not None and kept.is_file():
        found = nbformat.read(kept, as_version=4)
        if [cell.source for cell in found.cells] == [cell.source for cell in wanted.cells]:
            return found
    work = SITE / "work" / path.stem  # for the files that it writes
    work.mkdir(parents=True)
    for beside in path.parent.glob("*.py"):
        shutil.copy(beside, work)
    place = {"metadata": {"path": str(work)}}
    nbclient.NotebookClient(wanted, kernel_name="python3", resources=place, timeout=1800).execute()
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        nbformat.write(wanted, kept)
    return wanted


def as_markdown(notebook: nbformat.NotebookNode, target: Path) -> str:
    """Text, code and outputs of a notebook; its pictures beside `target`."""
    parts = []
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(re.sub(r"(\]\([^):]*)\.ipynb", r"\1.md", cell.source))
            continue
        parts.append(f"````python\n{cell.source}\n````")
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{target.stem}_{len(parts)}.png"
                (target.parent / name).write_bytes(base64.b64decode(data["image/png"]))
                parts.append(f"![The picture that this code draws]({name})")
            elif text := output.get("text") or data.get("text/plain"):
                parts.append(f"````text\n{text.rstrip()}\n````")
    return "\n\n".join(parts) + "\n"


# --- API ------------------------------------------------------------------------------------


def stage_api() -> None:
    """A page for each group of public names, and an index."""
    folder, index = SOURCE / "api", ["# API", "", "| name | what it is |", "|---|---|"]
    folder.mkdir()
    for group, names in public_names().items():
        title, _ = GROUPS[group]
        text = [f"# {title}", *(f"::: fractaljax.{name}" for name in names)]
        (folder / f"{group}.md").write_text("\n\n".join(text) + "\n", encoding="utf-8")
        index += [f"| [`{name}`][fractaljax.{name}] | {first_line(name)} |" for name in names]
    (folder / "index.md").write_text("\n".join(index) + "\n", encoding="utf-8")


def public_names() -> dict[str, list[str]]:
    """Every public name of the package, with those of `plot` and `constraints`, by group."""
    import fractaljax as fj

    found: dict[str, list[str]] = {group: [] for group in GROUPS}
    modules = {"": fj, "plot.": fj.plot, "constraints.": fj.constraints}
    for prefix, module in modules.items():
        for name in getattr(module, "__all__", vars(module)):
            value = getattr(module, name)
            # A function says that it is of the package that exports it.
            home = getattr(getattr(value, "__wrapped__", value), "__module__", None) or ""
            local = prefix != "constraints." or home == module.__name__
            if name.startswith("_") or not home.startswith("fractaljax.") or not local:
                continue
            if prefix + name in ("quantity", "plot", "FileLimits"):
                home = "fractaljax._mechanism"
            (group,) = [g for g, (_, of) in GROUPS.items() if home.split(".")[1] in of]
            found[group].append(prefix + name)
    return {group: sorted(names, key=str.lower) for group, names in found.items()}


def first_line(name: str) -> str:
    """The first line of a docstring, for a cell of a table."""
    import fractaljax as fj

    value = fj
    for part in name.split("."):
        value = getattr(value, part)
    return ((value.__doc__ or "").strip().split("\n")[0]).replace("|", "\\|")


# --- pictures -------------------------------------------------------------------------------


def stage_gallery() -> None:
    """A page of the pictures of docs, each with the page that shows it and the code that draws it.

    The code is beside the page, to be read without a repository.
    """
    folder, text = (
        SOURCE / "code",
        ["# Gallery", "Every picture is drawn by code of the repository."],
    )
    folder.mkdir()
    for picture in sorted((ROOT / "docs").glob("*.png")):
        caption, page, code = pictured(picture.name)
        cited = [f"[page]({page})"] if page else []
        if code is not None:
            shutil.copy(code, folder / f"{code.name}.txt")  # shown by a browser, not saved
            cited.append(f"[code](code/{code.name}.txt)")
        text.append(f"![{caption}](docs/{picture.name})")
        text.append(f"*{caption}.* {', '.join(cited)}")
    (SOURCE / "gallery.md").write_text("\n\n".join(text) + "\n", encoding="utf-8")


def pictured(name: str) -> tuple[str, str, Path | None]:
    """Caption of a picture of docs, the page that shows it, and the file of the code that draws it.

    A picture of validation is drawn by the module of its case. The page is an empty text where none
    shows the picture, and the code is None where the page has it, in a few lines or a command.
    """
    docs, code = ROOT / "docs", None
    if name.startswith("validation_"):
        case = f'"{name.removeprefix("validation_").removesuffix(".png")}"'
        modules = sorted((docs / "gallery").glob("*.py"))
        (code,) = [path for path in modules if re.search(rf"\bCase\(\s*{case}", text_of(path))]
    makers = [path for path in sorted(docs.glob("make_*.py")) if f'"{name}"' in text_of(path)]
    code = makers[0] if code is None and makers else code
    for page in (ROOT / "README.md", *sorted(docs.glob("*.md")), *sorted(docs.rglob("*/*.md"))):
        shown = re.search(rf"!\[([^\]]*)\]\([^)]*\b{re.escape(name)}\)", text_of(page))
        if shown:
            source = "index.md" if page.name == "README.md" else page.relative_to(ROOT).as_posix()
            return shown[1], source.replace("docs/site/", ""), code
    caption = (ast.get_docstring(ast.parse(text_of(code))) or "") if code else ""
    caption = caption.split(": ", 1)[-1].split(",")[0]
    return caption[:1].upper() + caption[1:], "", code


def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


# --- the rest -------------------------------------------------------------------------------


def stage_explore() -> None:
    """The page of sliders of the reference brake."""
    code = "import jax; jax.config.update('jax_enable_x64', True); import fractaljax as fj, sys; "
    code += "fj.plot.explore(fj.brake_scene(), sys.argv[1], progress=False)"
    subprocess.run([sys.executable, "-c", code, str(SOURCE / "explore.html")], check=True)


def settings() -> None:
    """docs/site/zensical.toml with the pages that are found."""
    names = sorted(path.stem for path in (SOURCE / "benchmarks" / "results").glob("*.md"))
    lists = {
        "notebooks": [f"notebooks/{path.stem}.md" for path in NOTEBOOKS],
        "api": ["api/index.md", *(f"api/{group}.md" for group in GROUPS)],
        "benchmarks": [f"benchmarks/results/{name}.md" for name in names if name != "index"],
    }
    text = (ROOT / "docs" / "site" / "zensical.toml").read_text(encoding="utf-8")
    for name, pages in lists.items():
        text = text.replace(f"@{name}@", "".join(f'"{page}",\n    ' for page in pages))
    text = text.replace("@version@", importlib.metadata.version("fractaljax"))
    (SITE / "zensical.toml").write_text(text.replace("@root@", ROOT.as_posix()), encoding="utf-8")


def with_equations(page: str) -> str:
    r"""A page with MathML in place of \(...\) and \[...\], with the number of \tag{...} beside."""

    import latex2mathml.converter

    def mathml(tex, display="inline"):
        text = latex2mathml.converter.convert(tex, display=display)
        # Names of functions stand off what they are applied to.
        return re.sub(
            r"(<mi>(?:ln|cos|sin)</mi>)(?!<mo|<mspace|</)", r'\1<mspace width="0.17em"/>', text
        )

    def inline(found):
        return mathml(html.unescape(found[1]))

    def block(found):
        tex, number = html.unescape(found[1]).strip(), ""
        if tag := re.search(r"\\tag\{(.*?)\}", tex):
            tex, number = tex.replace(tag[0], ""), f"<span>({tag[1]})</span>"
        return f'<div class="equation">{mathml(tex, "block")}{number}</div>'

    page = re.sub(r'<span class="arithmatex">\\\((.*?)\\\)</span>', inline, page, flags=re.DOTALL)
    return re.sub(
        r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', block, page, flags=re.DOTALL
    )


class _Links(html.parser.HTMLParser):
    """What a page links to, and the names in it."""

    def __init__(self):
        super().__init__()
        self.links: list[str] = []
        self.names: set[str] = set()

    def handle_starttag(self, tag, attrs):
        for key, value in attrs:
            if value and key in ("id", "name"):
                self.names.add(value)
            elif value and key in ("href", "src"):
                self.links.append(value)


def broken_links(folder: Path) -> list[str]:
    """Links within a site that lead to no file or to no place on a page, one a line."""
    seen: dict[Path, _Links] = {}
    for path in folder.rglob("*.html"):
        seen[path.resolve()] = links = _Links()
        links.feed(path.read_text(encoding="utf-8"))
    found = []
    for path, page in seen.items():
        if path.name == "404.html":  # served at any address
            continue
        for link in page.links:
            if re.match(r"[a-z]+:|//", link):
                continue
            target, anchor = urldefrag(link)
            aim = (path.parent / unquote(target)).resolve() if target else path
            aim = aim / "index.html" if aim.is_dir() else aim
            known = aim.is_file() and (
                not anchor or aim not in seen or unquote(anchor) in seen[aim].names
            )
            if not known:
                found.append(f"{path.relative_to(folder.resolve())}: {link} leads nowhere")
    return found


if __name__ == "__main__":
    sys.exit(main())
