#!/usr/bin/env python3
"""What releases contain next to the programs: notices of third parties, completions and manual pages.

    .ci/extras.py notices FILE              licences of every linked crate (cargo metadata; the sources must be there)
    .ci/extras.py pages COMMAND FOLDER      completions/ and man/man1/, from a built command

Python 3.10 without packages. Both commands, `splat4d` and its second name `s4d`, get their completions and pages.
"""

import json
import pathlib
import re
import subprocess
import sys

# What the archives and the wheels link.
PROGRAMS = ["splat4d", "splat4d-py"]
LICENCES = re.compile(r"^(licen[cs]e|copying|notice|unlicense|copyright)", re.IGNORECASE)
ENTRY = re.compile(r"((?:-{1,2}|<|\[)\S.*?|[a-z]+)(?:\s{2,}(.*))?$")
SHELLS = {"bash": "splat4d.bash", "zsh": "_splat4d", "fish": "splat4d.fish", "powershell": "splat4d.ps1", "elvish": "splat4d.elv"}


def linked(metadata):
    """Packages of registries that the programs link, by name and version. Build scripts and tests are left out."""
    packages = {p["id"]: p for p in metadata["packages"]}
    nodes = {n["id"]: n for n in metadata["resolve"]["nodes"]}
    todo = [i for i, p in packages.items() if p["name"] in PROGRAMS and p["source"] is None]
    assert len(todo) == len(PROGRAMS), f"the workspace has {len(todo)} of {PROGRAMS}"
    seen = set(todo)
    while todo:
        for dep in nodes[todo.pop()]["deps"]:
            if dep["pkg"] not in seen and any(k["kind"] is None for k in dep["dep_kinds"]):
                seen.add(dep["pkg"])
                todo.append(dep["pkg"])
    return sorted((packages[i] for i in seen if packages[i]["source"]), key=lambda p: (p["name"], p["version"]))


def texts(package):
    """Licence texts in a package: (name of the file, text)."""
    folder = pathlib.Path(package["manifest_path"]).parent
    files = sorted(f for f in folder.iterdir() if f.is_file() and LICENCES.match(f.name))
    if (own := package["license_file"]) and folder / own not in files:
        files.append(folder / own)
    # Of a choice that includes it, splat4d takes MIT; a notice of copyright stays.
    choice = re.split(r" OR |/", package["license"] or "")
    if "MIT" in choice and " AND " not in package["license"] and any("MIT" in f.name.upper() for f in files):
        files = [f for f in files if "MIT" in f.name.upper() or f.name.upper().startswith(("NOTICE", "COPYRIGHT"))]
    return [(f.name, f.read_text(encoding="utf-8", errors="replace").replace("\r\n", "\n").strip()) for f in files]


def notices(path):
    command = ["cargo", "metadata", "--format-version", "1", "--locked", "--all-features"]
    # The registry's sources must be there: `cargo fetch` before.
    packages = linked(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
    users, bare = {}, []
    for package in packages:
        found = texts(package)
        for _, text in found:
            users.setdefault(text, []).append(f"{package['name']} {package['version']}")
        if not found:
            bare.append(package)
    out = ["Licences of third-party code in splat4d", "=" * 39, ""]
    out += ["splat4d itself is licensed as MIT or Apache-2.0, at your choice. It links these Rust crates:", ""]
    out += [f"    {p['name']} {p['version']}: {p['license'] or 'see below'}, {p['repository'] or p['homepage'] or 'crates.io'}" for p in packages]
    if bare:
        out += ["", "These crates contain no licence text. Their authors, with the licence that they state:", ""]
        for p in bare:
            out.append(f"    {p['name']} {p['version']}: {p['license']}, {', '.join(p['authors']) or 'the authors of ' + p['name']}")
        root = pathlib.Path(__file__).resolve().parent.parent
        users.setdefault((root / "LICENSE-APACHE").read_text().strip(), []).append("crates without a licence text")
    for text, names in sorted(users.items(), key=lambda e: (-len(e[1]), e[1])):
        out += ["", "-" * 80, *(f"{', '.join(names)}:".splitlines()), "", text]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(out) + "\n", encoding="utf-8", newline="\n")
    print(f"{path}: {len(packages)} crates, {len(users)} texts, {len(bare)} crates without one, {path.stat().st_size} bytes")


def run(command, *args):
    return subprocess.run([command, *args], check=True, capture_output=True, text=True, encoding="utf-8").stdout


def both(shell, text):
    """Completions of `splat4d` that serve `s4d` too."""
    if shell == "bash":
        text = re.sub(r"(complete -F _splat4d .*) splat4d\n", r"\1 splat4d s4d\n", text)
    elif shell == "zsh":
        text = text.replace("#compdef splat4d\n", "#compdef splat4d s4d\n").replace("compdef _splat4d splat4d\n", "compdef _splat4d splat4d s4d\n")
    elif shell == "fish":
        text += "complete -c s4d -w splat4d\n"
    elif shell == "powershell":
        text = text.replace("-CommandName 'splat4d'", "-CommandName 'splat4d', 's4d'")
    elif shell == "elvish":
        text += "set edit:completion:arg-completer[s4d] = {|@words| $edit:completion:arg-completer[splat4d] splat4d $@words[1..] }\n"
    assert "s4d" in text.replace("splat4d", ""), f"completions of {shell} have another form"
    return text


def roff(text):
    """Text of a line of a manual page."""
    text = text.replace("\\", "\\e").replace("-", "\\-")
    text = "".join(c if c.isascii() else f"\\[u{ord(c):04X}]" for c in text)
    return "\\&" + text if text.startswith((".", "'")) else text


def page(name, help_text, version, others):
    """A manual page of a command's `--help`."""
    summary, _, rest = help_text.partition("\n")
    out = [f'.TH "{name.upper()}" "1" "" "{version}" "splat4d"', ".SH NAME", f"{roff(name)} \\- {roff(summary)}"]
    filled = False
    for line in rest.splitlines():
        bare = line.strip()
        indent = len(line) - len(line.lstrip())
        if not bare:
            filled = False
        elif line.startswith("Usage: "):
            out += [".SH SYNOPSIS", ".nf", roff(re.sub(r"^Usage: \S+", "splat4d", line)), ".fi"]
        elif indent == 0 and bare.endswith(":"):
            out += [f".SH {roff(bare[:-1].upper())}"]
            filled = False
        elif bare.startswith("Exit codes: "):
            out += [".SH EXIT STATUS", roff(bare.removeprefix("Exit codes: "))]
        elif section_is_literal(out):
            out += [".nf", roff(line), ".fi"]
        # Flags and arguments have their text below or to the right, verbs to the right.
        elif 0 < indent < 10 and (match := ENTRY.match(bare)) and (bare[0] in "-<[" or match[2]):
            out += [".TP", f"\\fB{roff(match[1])}\\fR", *([roff(match[2])] if match[2] else [])]
            filled = True
        else:
            out += ([] if filled or not out[-1].startswith("\\") else [".PP"]) + [roff(bare)]
            filled = True
    out += [".SH SEE ALSO", ", ".join(f"\\fB{roff(o)}\\fR(1)" for o in others), ".PP", "https://github.com/splat4d/splat4d"]
    return "\n".join(out) + "\n"


def section_is_literal(out):
    """Examples keep their lines."""
    section = next((line for line in reversed(out) if line.startswith(".SH ")), "")
    return section in (".SH EXAMPLES", ".SH SYNOPSIS")


def pages(command, folder):
    command = command.resolve()
    if not command.exists():
        command = command.with_suffix(".exe")
    version = run(command, "--version").splitlines()[0]
    completions, man = folder / "completions", folder / "man/man1"
    for place in (completions, man):
        place.mkdir(parents=True, exist_ok=True)
    for shell, name in SHELLS.items():
        (completions / name).write_text(both(shell, run(command, "completions", shell)), encoding="utf-8", newline="\n")
    top = run(command, "--help")
    verbs = re.findall(r"^  ([a-z]+) ", top.partition("Commands:\n")[2].partition("\n\n")[0], re.MULTILINE)
    verbs = [v for v in verbs if v != "help"]
    assert len(verbs) > 10, f"the command lists {verbs}"
    names = {"splat4d": [], **{f"splat4d-{v}": [v] for v in verbs}}
    for name, verb in names.items():
        text = page(name, run(command, *verb, "--help"), version, [n for n in names if n != name] if not verb else ["splat4d"])
        (man / f"{name}.1").write_text(text, encoding="utf-8", newline="\n")
    (man / "s4d.1").write_text(".so man1/splat4d.1\n", newline="\n")
    print(f"{folder}: completions for {len(SHELLS)} shells, {len(names) + 1} manual pages")


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["notices", file]:
            notices(pathlib.Path(file))
        case ["pages", command, folder]:
            pages(pathlib.Path(command), pathlib.Path(folder))
        case _:
            sys.exit(__doc__)
