"""Compares the features of third-party crates between the packages that are built one by one.

What differs is compiled anew when another package is built. The remedy is a line in compose/features/Cargo.toml.
"""

import subprocess
import sys

BUILDS = {
    "demo": ["-p", "demo"],
    "car-node": ["-p", "car-node"],
    "pitwall": ["-p", "pitwall", "--no-default-features"],
    "pitwall with rerun": ["-p", "pitwall"],
    "workspace": ["--workspace"],
}


def features(arguments):
    """Features by crate and version, as far as normal and build dependencies ask for them."""
    command = ["cargo", "tree", "--edges", "normal,build", "--prefix", "none", "--format", "{p}|{f}", *arguments]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    crates = {}
    for line in output.splitlines():
        package, _, names = line.replace(" (*)", "").partition("|")
        if package and "(/" not in package:
            crates.setdefault(package.replace(" (proc-macro)", ""), set()).update(filter(None, names.split(",")))
    return crates


def main():
    of = {name: features(arguments) for name, arguments in BUILDS.items()}
    differ = 0
    for name in list(BUILDS)[1:3]:
        for package, theirs in sorted(of[name].items()):
            demo = of["demo"].get(package)
            if demo is not None and demo != theirs:
                differ += 1
                print(f"{package}: demo and {name} differ in {', '.join(sorted(demo ^ theirs))}")
    print(f"{differ} crates are compiled anew for another package")
    if "--all" in sys.argv:
        for package, theirs in sorted(of["pitwall with rerun"].items()):
            demo = of["demo"].get(package)
            if demo is not None and demo != theirs:
                print(f"{package}: with rerun {', '.join(sorted(demo ^ theirs))}")
    return differ != 0


if __name__ == "__main__":
    sys.exit(main())
