"""MkDocs hooks that turn repository files linked from the docs into pages of the site."""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
# A link of Markdown to a file outside of docs/, which is a folder up or two.
OUTSIDE = re.compile(r"\]\(((?:\.\./)+[^)#\s]+)(#[^)\s]*)?\)")
LANGUAGES = {".py": "python", ".js": "javascript", ".cpp": "cpp", ".toml": "toml", ".ino": "cpp", ".service": "ini"}
DECISIONS = "decisions"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each file or folder that is linked to, and the list of decisions."""
    pages = [file for file in files if file.src_uri.endswith(".md")]
    outside = {target for page in pages for target in _targets(page) if not target.is_relative_to(ROOT / "docs")}
    for folder in [target for target in outside if target.is_dir()]:
        outside |= set(_shown_of(folder))
    for target in sorted(outside):
        files.append(File.generated(config, _page_of(target), content=_shown(target)))
    decided = sorted(page.src_uri for page in pages if page.src_uri.startswith(f"{DECISIONS}/"))
    titles = [(ROOT / "docs" / uri).read_text(encoding="utf-8").splitlines()[0].lstrip("# ") for uri in decided]
    links = [f"- [{title}]({Path(uri).name})" for title, uri in zip(titles, decided, strict=True)]
    text = "# Decisions\n\nWhy things are as they are.\n\n" + "\n".join(links) + "\n"
    files.append(File.generated(config, f"{DECISIONS}/index.md", content=text))
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Turn links to files outside of docs/ into links to their pages."""
    depth = page.file.src_uri.count("/")
    here = (ROOT / "docs" / page.file.src_uri).parent

    def replaced(match: re.Match[str]) -> str:
        target = (here / match[1]).resolve()
        if target.is_relative_to(ROOT / "docs") or not target.exists():
            return match[0]
        return f"]({'../' * depth}{_page_of(target)})"

    return OUTSIDE.sub(replaced, markdown)


def _targets(page: File) -> list[Path]:
    if page.abs_src_path is None:
        return []
    source = Path(page.abs_src_path)
    found = [(source.parent / link).resolve() for link, _ in OUTSIDE.findall(source.read_text(encoding="utf-8"))]
    return [target for target in found if target.exists()]


def _page_of(target: Path) -> str:
    """Return the path in the site of a file of the repository."""
    return f"files/{target.relative_to(ROOT).as_posix().rstrip('/')}.md"


def _shown(target: Path) -> str:
    """Return the page of a file, or for a folder the list of its files."""
    name = target.relative_to(ROOT).as_posix()
    if target.is_dir():
        inside = [file.relative_to(target).as_posix() for file in _shown_of(target)]
        links = [f"- [{file}]({target.name}/{file}.md)" for file in inside]
        return f"# {name}\n\n" + "\n".join(links) + "\n"
    text = target.read_text(encoding="utf-8")
    if target.suffix == ".md":
        return text
    return f"# {name}\n\n````{LANGUAGES.get(target.suffix, 'text')}\n{text}````\n"


def _shown_of(folder: Path) -> list[Path]:
    """List the text files of a folder and its subfolders."""
    return sorted(file for file in folder.rglob("*") if file.suffix in {*LANGUAGES, ".urdf", ".md"})
