"""Checks that the links and the file names in the Markdown pages lead somewhere.

    python3 .ci/check_docs.py
"""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def anchors(text):
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", text, re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def main():
    files = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()
    paths = {"/" + path for path in files}
    folders = {"/" + str(parent) + "/" for path in files for parent in Path(path).parents}
    faults = []
    for page in (ROOT / path for path in files if path.endswith(".md")):
        text = page.read_text()
        name = page.relative_to(ROOT)
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            file, _, anchor = target.partition("#")
            if "://" in target:
                continue
            to = (page.parent / file) if file else page
            if not to.exists():
                faults.append(f"{name}: {target} is not there")
            elif anchor and anchor not in anchors(to.read_text()):
                faults.append(f"{name}: {target} has no such heading")
        if page.name != "ARCHITECTURE.md":
            continue
        # `filter.rs`, `evaluate/` and the like: some file or folder ends with that.
        for code in re.findall(r"`([\w./-]+(?:\.rs|\.py|\.js|\.txt|\.toml|\.yaml|/))`", text):
            if not any(path.endswith("/" + code.lstrip("/")) for path in (folders if code.endswith("/") else paths)):
                faults.append(f"{name}: there is no {code}")
    print("\n".join(faults) or f"{len(files)} files, all links and names lead somewhere")
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
