"""Inputs of tables: runs and files of their cells, titles. Needs methods.smk."""

# Tables of distances. The others have their own rules.
OTHER_TABLES = ("table4", "stress")
CHAMFER_TABLES = [name for name in SETTINGS.tables if name not in OTHER_TABLES]


wildcard_constraints:
    table="|".join(CHAMFER_TABLES) or "none",


def random_scenes():
    """Shape, family and prior of each random scene."""
    plain = {name: SETTINGS.scene(name) for name in SETTINGS.random_scenes}
    return {
        name: {"shape": scene.shape, "family": SETTINGS.random.family(name), "prior": scene.prior}
        for name, scene in plain.items()
    }


def random_files(methods, name):
    """A file of every random scene under some methods, method by method."""
    return [f"{RESULTS}/{scene}/{method}/{name}" for method in methods for scene in SETTINGS.random_scenes]


def pile_files(name):
    """Files of a random scene of several bodies for its table, by content."""
    alone = SETTINGS.body_scenes(name)
    laws = "true_law", "constants"
    return {
        "identified": [f"{RESULTS}/{name}/identified.json"],
        "metrics": [f"{RESULTS}/{name}/{law}/metrics.json" for law in laws],
        "alone": [f"{RESULTS}/{body}/identified.json" for body in alone],
        "alone_metrics": [f"{RESULTS}/{body}/constants/metrics.json" for body in alone],
        "rest": [f"{RESULTS}/experiments/{name}_rest/{law}/metrics.json" for law in laws],
    }


def identified_scenes():
    """Every identification in a table: the scenes of table1 in all replicates, and the random scenes."""
    table, constants = SETTINGS.tables.get("table1"), cases.of_kind(SETTINGS, "constants")[:1]
    runs = [
        run
        for s in (table.scenes if table else ())
        for m in constants
        for run in cases.runs(SETTINGS, "table1", m, s)
    ]
    named = dict.fromkeys((Path(run).parent.name for run in runs), "scenes of Table 1")
    return with_truths(
        named | dict.fromkeys(SETTINGS.random_scenes, f"random scenes, seed {SETTINGS.random.seed}")
    )


def identified_behind(table):
    """The same of every scene whose identified constants have a row in a table."""
    rows = [case_on(run["scene"], run["method"]) for run in table_runs(table) if run["scene"]]
    scenes = [case.scene for case in rows if "identified" in case.method.model_inputs(case)]
    return with_truths({Path(result_path(scene, "identified.json")).parent.name: table for scene in scenes})


def with_truths(groups):
    """Scenes with their groups and true laws."""
    return [
        {"name": name, "group": group, "truth": SETTINGS.scene(name).law.plain()}
        for name, group in groups.items()
    ]


def method_runs(table, method):
    """Every run behind a row of a table: its method, column, folder of the scene, and folder."""
    chosen = SETTINGS.tables[table]
    return [
        {
            "method": method,
            "column": column,
            "scene": run.partition("/")[0] if column in chosen.scenes else None,
            "folder": f"{RESULTS}/{run}" if column in chosen.scenes else f"{RESULTS}/experiments/{run}",
        }
        for column in (*chosen.scenes, *chosen.experiments)
        for run in cases.runs(SETTINGS, table, method, column)
    ]


def table_runs(table):
    """Every run behind a table, row by row and replicate by replicate, see `method_runs`."""
    return [run for method in SETTINGS.tables[table].methods for run in method_runs(table, method)]


def table_files(table, name):
    """A file of every run behind a table, in the order of `table_runs`."""
    return [f"{run['folder']}/{name}" for run in table_runs(table)]


def table_cells(table):
    """Method and column of every run behind a table, in the order of `table_runs`."""
    return [[run["method"], run["column"]] for run in table_runs(table)]


def table_titles(table):
    """Row names of a table by method."""
    chosen = SETTINGS.tables[table]
    return {m: chosen.titles.get(m) or cases.title(SETTINGS, m) for m in chosen.methods}


def table_notes(table):
    """Notes to the rows of a table, by method."""
    notes = {m: cases.preset(SETTINGS, m)[0].note for m in SETTINGS.tables[table].methods}
    return {method: note for method, note in notes.items() if note}


def table_columns(table):
    """Headings of a table by scene and experiment."""
    chosen = SETTINGS.tables[table]
    return {s: s for s in chosen.scenes} | {n: SETTINGS.experiments[n].title for n in chosen.experiments}
