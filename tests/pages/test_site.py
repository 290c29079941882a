"""The documentation site: its sources name what there is, and it is whole in a browser."""

import re

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

import fractaljax as fj
from browser import chromium, complaints, served
from tools import DOCS, ROOT, load_script

BUILD = load_script(DOCS / "build.py")
SITE = ROOT / "build" / "site" / "html"
SOURCES = sorted((DOCS / "site").rglob("*.md"))
SETTINGS = (DOCS / "site" / "zensical.toml").read_text(encoding="utf-8")


def test_every_name_and_page_is_there_once():
    names = [name for names in BUILD.public_names().values() for name in names]
    assert len(names) == len(set(names)) > 100
    assert {"growth_rate", "Scene", "plot.explore", "constraints.CycleAmplitude"} <= set(names)
    public = {name for name in vars(fj)["__all__"] if hasattr(getattr(fj, name), "__module__")}
    assert {name for name in public if not name.startswith("_")} == {
        n for n in names if "." not in n
    }
    assert all(BUILD.first_line(name) for name in names)
    assert [path.name for path in DOCS.glob("*.md") if f'"docs/{path.name}"' not in SETTINGS] == []


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.stem)
def test_sources_name_what_there_is(path):
    """Names of the API, and pages of the navigation."""
    text = path.read_text(encoding="utf-8")
    for name in re.findall(r"\]\[fractaljax\.([\w.]+)\]", text):
        assert hasattr(fj, name), name
    page = path.relative_to(DOCS / "site").as_posix()
    assert f'"{page}"' in SETTINGS


def test_every_picture_has_a_caption_a_page_or_the_code_that_draws_it():
    for picture in sorted(DOCS.glob("*.png")):
        caption, page, code = BUILD.pictured(picture.name)
        assert caption and (page or code), picture.name
        assert not page or f'"{page}"' in SETTINGS
        if code is not None:
            assert picture.stem.removeprefix("validation_") in code.read_text(encoding="utf-8")


def test_notebooks_become_pages(tmp_path):
    """Text, code, what it printed and its pictures; links to notebooks lead to their pages."""
    code = new_code_cell("1 + 1", outputs=[new_output("stream", text="two\n")])
    code.outputs.append(new_output("display_data", {"image/png": "aGVsbG8=", "text/plain": "x"}))
    text = BUILD.as_markdown(
        new_notebook(cells=[new_markdown_cell("# A\n[next](2_b.ipynb)"), code]), tmp_path / "a.md"
    )
    assert "# A\n[next](2_b.md)" in text and "````python\n1 + 1\n````" in text
    assert "````text\ntwo\n````" in text and "](a_3.png)" in text
    assert (tmp_path / "a_3.png").read_bytes() == b"hello"


def test_kept_notebooks_are_taken_while_their_cells_are_the_same(tmp_path, monkeypatch):
    path, kept = tmp_path / "a.ipynb", tmp_path / "kept"
    kept.mkdir()
    monkeypatch.setenv("FRACTALJAX_EXECUTED", str(kept))
    monkeypatch.setattr(BUILD, "SITE", tmp_path)
    cell = new_code_cell("print(1)", outputs=[new_output("stream", text="kept")])
    nbformat.write(new_notebook(cells=[cell]), kept / path.name)
    nbformat.write(new_notebook(cells=[new_code_cell("print(1)")]), path)
    assert BUILD.executed(path).cells[0].outputs[0].text == "kept"
    nbformat.write(new_notebook(cells=[new_code_cell("print(2)")]), path)
    assert BUILD.executed(path).cells[0].outputs[0].text == "2\n"
    assert nbformat.read(kept / path.name, 4).cells[0].outputs[0].text == "2\n"


def test_broken_links_are_found(tmp_path):
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "index.html").write_text('<a id="here" href="../a.html#there"></a>')
    good = '<p id="there"><a href="b/#here"></a><a href="b"></a><img src="a.html">'
    (tmp_path / "a.html").write_text(good + '<a href="https://x.y"></a><a href="#there"></a>')
    assert BUILD.broken_links(tmp_path) == []
    (tmp_path / "a.html").write_text('<a href="b/#gone"></a><img src="c.png"><a href="#no"></a>')
    found = BUILD.broken_links(tmp_path)
    assert len(found) == 4 and "a.html: b/#gone leads nowhere" in found


def test_equations_become_mathml():
    pytest.importorskip("latex2mathml", reason="needs the docs extra: pip install .[docs]")
    page = r'<p><span class="arithmatex">\(a &lt; \ln x\)</span></p>'
    page += r'<div class="arithmatex">\[ x^2 = \frac12 \tag{21} \]</div>'
    text = BUILD.with_equations(page)
    assert text.count("<math") == 2 and "arithmatex" not in text and "\\" not in text
    assert "<span>(21)</span>" in text and "<mfrac>" in text and "&#x0003C;" in text  # <


@pytest.fixture(scope="module")
def site():
    """A browser and the address of the site that was built last."""
    if not SITE.is_dir():
        pytest.skip("there is no site: python docs/build.py builds one")
    with served(SITE) as address, chromium() as browser:
        yield browser, address


@pytest.mark.slow
def test_every_page_is_whole(site):
    """No word on the console, every picture there, every equation set."""
    browser, address = site
    pages = sorted(path.relative_to(SITE).as_posix() for path in SITE.rglob("*.html"))
    assert len(pages) > 40
    for page in pages:
        browser.get(f"{address}/{page}")
        pictures = browser.execute_script(
            """for (const image of document.images) image.loading = "eager";
            return Promise.all([...document.images].map(image => image.decode().then(
                () => null, () => image.src))).then(all => all.filter(src => src));"""
        )
        assert pictures == [], page
        assert complaints(browser) == [], page
        left = browser.execute_script("return document.querySelectorAll('.arithmatex').length")
        assert left == 0, page
    browser.get(f"{address}/index.html")
    wide = "return [...document.images].map(image => image.naturalWidth)"
    assert max(browser.execute_script(wide)) > 500  # README's picture


@pytest.mark.slow
def test_equations_are_typeset(site):
    """Their numbers stand beside them, in the font that the site brings."""
    browser, address = site
    browser.get(f"{address}/concepts/contact/")
    numbers = browser.execute_script(
        "return [...document.querySelectorAll('.equation > span')].map(e => e.textContent)"
    )
    assert numbers == ["(2)", "(21)", "(25)", "(26)", "(30)", "(33)", "(36)"]
    font = "return document.fonts.ready.then(f => [...f].some(x => x.status === 'loaded'))"
    assert browser.execute_script(font)
    wider = "e => e.offsetWidth > e.clientWidth"  # by a vertical scroll bar
    scrolls = f"return [...document.querySelectorAll('.equation')].some({wider})"
    assert not browser.execute_script(scrolls)
    tall = "return document.querySelector('.equation mfrac').getBoundingClientRect().height"
    assert browser.execute_script(tall) > 25


@pytest.mark.slow
def test_search_finds_growth_rate(site):
    from selenium.webdriver import ActionChains
    from selenium.webdriver.support.wait import WebDriverWait

    browser, address = site
    browser.get(f"{address}/index.html")
    browser.find_element("css selector", ".md-search__button").click()
    roots = "[...document.querySelectorAll('*')].flatMap(e => e.shadowRoot ?? [])"
    opened = f"return {roots}.some(root => root.querySelector('input'))"
    links = f"return {roots}.flatMap(root => [...root.querySelectorAll('a')]).map(a => a.href)"
    wait = WebDriverWait(browser, 20)
    wait.until(lambda browser: browser.execute_script(opened))
    ActionChains(browser).send_keys("growth_rate").perform()
    page = f"{address}/api/stability/"

    def found(browser):  # results of the first letters come first
        shown = browser.execute_script(links)
        return any(x.startswith(page) and x.endswith("#fractaljax.growth_rate") for x in shown)

    wait.until(found)
    assert complaints(browser) == []


@pytest.mark.slow
def test_page_to_play_with_is_part_of_it(site):
    from selenium.common.exceptions import NoSuchElementException
    from selenium.webdriver.support.wait import WebDriverWait

    browser, address = site
    browser.get(f"{address}/play/")
    browser.switch_to.frame(browser.find_element("css selector", "iframe.explore"))
    wait = WebDriverWait(browser, 20, ignored_exceptions=(NoSuchElementException,))
    wait.until(lambda browser: browser.find_element("id", "growth_rate").text)
    assert browser.find_element("id", "growth_rate").text == "+22.080 1/s"
    assert "Computed at this point" in browser.find_element("id", "cycle-note").text
