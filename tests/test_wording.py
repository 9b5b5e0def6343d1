"""Plain technical English: words and names that neither code nor pages use, and what to write instead."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

READ = ("*.py", "*.smk", "*Snakefile", "*.md", "*.yaml", "*.yml", "*.html", "*.js", "*.toml", "Makefile")

# In prose, and as a part of a name with underscores, in any case.
WORDS = {
    "throw throws thrown threw throwing": "launch, initial motion; of a capture: take",
    "tell tells told telling": "inform, state, determine; tell apart: distinguish",
    "say says said saying": "state; in code: log, message",
    "anew": "again; made anew: regenerated",
    "beside besides": "next to, with, compared with, in addition to",
    "nought noughts": "zero",
    "likewise": "also",
    "thereby": "a sentence of its cause",
    "doubt doubts": "warning",
    "plate plates": "background",
    "chain chains": "replicate",
    "yardstick yardsticks": "reference",
    "judge judges judged judging judgement": "evaluate, score",
    "refill refills refilled refilling": "resample",
    "outlines": "silhouettes",
    "arc arcs": "ballistic track",
    "thing things": "the name of the object",
    "bring brings brought bringing": "transfer, move, cause",
    "misplaced": "pose_tolerance",
    "stock": "published",
    "carrier carriers": "particle_source",
}

# In any case. A word after a bracket may be any of those between the bars.
PHRASES = {
    "of its own|of their own|of his own": "its own ...",
    "give up|gives up|given up|gave up|giving up": "stop, drop, abandon",
    "goes by|go by|went by": "uses, follows",
    "lies deep|lie deep|lay deep": "is inside",
    "as it is|as it was|as they are|as they were": "unchanged",
    "comes out|come out|came out|coming out": "results in, is",
    "looks at|look at|looked at|looking at": "inspect, read, examine",
    "apart from|kept apart|keep apart|keeps apart|held apart|set apart": "except; separate",
    "shown video|shown videos|shown film|shown image|shown images|shown frames": "display video",
}

# Whole identifiers.
IDENTIFIERS = {
    "look_closer": "measure_discretisation",
    "trained_as": "same_fit_as",
    "judged_on": "evaluate_on",
    "sub_frames": "exposure_samples",
    "_leave_behind _adds_nothing _begun": "_prune, _is_redundant, _first_fit",
    "load_body load_start": "load_reconstruction, load_initial_state",
    "settings_around": "Project.find",
    "any_step": "any_time_step",
    "redrawn_masks": "mask_refinement",
    "on_request": "default_target",
    "if_made": "nothing: the graph does not depend on existing files",
}

# English words that are no names of variables, functions or classes: pattern of their use as one.
_VARIABLE = r"(?<![\w-])(?:{0}(?=\s*(?:(?:[-+*/|&]|//)?=(?!=)|\[|\.[a-z]|,\s*\w+\s*=))|for {0} in\b|{0}_\w+|\w+_{0}\b)"
_ALONE = r"(?<![\w-]){0}(?=\s*(?:(?:[-+*/|&]|//)?=(?!=)|\[|\.[a-z]|,\s*\w+\s*=))"
_CALLED = r"(?<![\w-])\w*{0}\("
_CLASS = r"\b(?:class {0}|{0}(?=[]()]))"
NAMES = {
    "found": (_VARIABLE, "the name of the object"),
    "shown": (_VARIABLE, "displayed, visible, selected, or the name of the object"),
    "finer further apart": (_ALONE, "refined, other_*, separate_adaptor"),
    "forget": (_CALLED, "clear_cache"),
    "reconsider": (_CALLED, "restart_from"),
    "disagree": (_CALLED, "disagreement"),
    "widened": (_CALLED, "covariance_of_plateaus"),
    "try trial choice": (_CLASS, "Candidate, Score, Selection"),
    "least": (r"(?<!\w)_?(?:least|LEAST)_(?!squares)\w+", "MIN_*, min_*"),
    "most": (r"(?<!\w)_?(?:most|MOST)_\w+", "MAX_*, max_*"),
}

# Text that is not read: pattern, reason.
ALLOWED = {
    r"throw new |throw e\w*": "statements of JavaScript",
    r"chain rule|import chain|\bchain\(|chain\.from_iterable|\.most_common": "names of analysis and of Python",
    r"arc3,rad": "an argument of matplotlib",
    r"without the carrier": "of a signal",
    r"method,throw,camera": "columns of a table",
    r"three_chains|table1_chains|two_throws\w*": "names of settings and of result files",
    r"\byardstick(?:\.\w+\b|(?=[\"':,}\]])| in )": "name of a table",
    r"_throw(?:\d|\{)|figures\.beside|\bbeside(?:: tuple|: \[|(?=[\"'`]))": "names of scenes and of a setting",
    r"\bthrows?(?::|\.<name>|(?=[\"'`]))|throws=\d|\w+\.throws\b|captured\.throw\b": "names of settings",
    r"inputs\.shown|params\.shown|throw: str \| None|\.on_request\b": "names of settings and of inputs",
    r"\bcarriers\b": "name of a setting",
    r"[\"'`.](?:throw|spin_told|least_iou|shown|arcs|says|any_step)[\"'`]": "keys of files",
    r"[\"'`.](?:plate|plate_gain|plate_offset)[\"'`]": "keys of files",
    r"[\"'`.](?:on_request|trained_as|judged_on)[\"'`]": "former names of settings",
    r"[\"'`]stock[\"'`]|guesses to stock": "value of a setting",
    r"plate_samples|beside_cameras|\"plate_\"": "settings and arrays of the demo captures",
    r"from outlines|gravity in outlines|down in outlines|\"outlines\"\)": "rows of the table captures_demo",
    r"two samplings of the true body": "a description that files store",
}

# Rooms that are not clean yet, as prefixes of paths: reason.
PENDING = {
    "CHANGELOG.md": "names of former versions",
    "neuma_lib/project/renames.py": "names of former versions",
    "studies/capture_benchmark/rules.smk": "being rewritten",
    "studies/capture_benchmark/scripts/": "being rewritten",
    "tests/workflow/": "being rewritten",
}


def rules() -> list[tuple[set[str], re.Pattern, str]]:
    """Lower-case words of which a text must have one, the expression to search for then, and what to write."""
    listed = []
    for words, instead in WORDS.items():
        one = "|".join(words.split())
        listed.append((set(words.split()), rf"(?<![A-Za-z])(?i:{one})(?![A-Za-z])", instead))
    for phrases, instead in PHRASES.items():
        first = {phrase.split()[0] for phrase in phrases.split("|")}
        listed.append((first, rf"\b(?i:{phrases.replace(' ', chr(92) + 's+')})\b", instead))
    for names, instead in IDENTIFIERS.items():
        first = {name.strip("_").split("_")[0] for name in names.split()}
        listed.append((first, rf"(?<!\w)(?:{'|'.join(names.split())})(?!\w)", instead))
    for names, (use, instead) in NAMES.items():
        for name in names.split():
            spelled = name.capitalize() if use == _CLASS else name
            listed.append(({name}, use.format(spelled), instead))
    return [(words, re.compile(pattern), instead) for words, pattern, instead in listed]


RULES, NOT_READ = rules(), re.compile("|".join(ALLOWED))


def problems(text: str, name: str) -> list[str]:
    """`file:line: word: write ...` for each forbidden word."""
    words = set(re.findall("[a-z]+", text.lower()))
    searched = [(pattern, instead) for first, pattern, instead in RULES if first & words]
    if not searched:
        return []
    text = NOT_READ.sub(lambda match: " " * len(match[0]), text)
    hits = sorted((match.start(), match[0], instead) for p, instead in searched for match in p.finditer(text))
    return [f"{name}:{text.count(chr(10), 0, at) + 1}: {word}: write {instead}" for at, word, instead in hits]


def tracked() -> list[str]:
    """Files that Git tracks or would add, without this one."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", *READ]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True)
    if listed.returncode:
        pytest.skip("Git lists the files, and this folder is no repository")
    names = set(listed.stdout.decode().split("\0")) - {
        "",
        Path(__file__).resolve().relative_to(ROOT).as_posix(),
    }
    return sorted(name for name in names if (ROOT / name).is_file())


def test_texts_have_no_forbidden_words():
    read = [name for name in tracked() if not name.startswith(tuple(PENDING))]
    hits = [hit for name in read for hit in problems((ROOT / name).read_text(), name)]
    assert not hits, "\n".join(hits)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("It is thrown.\nx = least_squares(thrown_video)", ["thrown", "thrown"]),
        ("found = 1\nIt was found in a file. found.append(1)", ["found", "found"]),
        ("MOST_FRAMES = 3\nat most 3", ["MOST_FRAMES"]),
        ("class Trial:\nTrial and error", ["class Trial"]),
        ("the template's arctan2 says nothing", ["says"]),
        ("throw new Error(); the chain rule; load_body(x)", ["load_body"]),
        ("Except as it is, of Its own", ["as it is", "of Its own"]),
    ],
)
def test_words_are_recognised(text, words):
    assert [line.split(": ")[1] for line in problems(text, "a.py")] == words


if __name__ == "__main__":  # python tests/test_wording.py FOLDER ...: also what is pending
    for name in tracked():
        if name.startswith(tuple(sys.argv[1:]) or ""):
            for hit in problems((ROOT / name).read_text(), name):
                print(hit)
