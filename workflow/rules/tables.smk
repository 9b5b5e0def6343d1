"""What tables are made of: runs, files and records of their cells, titles. Needs methods.smk."""

# Tables of distances; the others have rules of their own.
OTHER_TABLES = ("table4", "learning_rates", "bias", "stress")
CHAMFER_TABLES = [name for name in SETTINGS.tables if name not in OTHER_TABLES]


wildcard_constraints:
    table="|".join(CHAMFER_TABLES) or "none",


def random_scenes():
    """What tables of random scenes say of each."""
    plain = {name: SETTINGS.scene(name) for name in SETTINGS.random_scenes}
    return {
        name: {"shape": scene.shape, "family": SETTINGS.random.family(name), "prior": scene.prior}
        for name, scene in plain.items()
    }


def random_files(methods, name):
    """A file of every random scene under some methods, method by method."""
    return [f"{RESULTS}/{scene}/{method}/{name}" for method in methods for scene in SETTINGS.random_scenes]


def identified_scenes():
    """Every identification that a table judges: the scenes of table1 in all its chains, and the random scenes."""
    table, methods = SETTINGS.tables.get("table1"), SETTINGS.methods
    constants = [name for name in methods if SETTINGS.is_identified(name)][:1]
    runs = [
        run
        for s in (table.scenes if table else ())
        for m in constants
        for run in SETTINGS.runs("table1", m, s)
    ]
    named = dict.fromkeys((Path(run).parent.name for run in runs), "scenes of Table 1")
    return with_truths(
        named | dict.fromkeys(SETTINGS.random_scenes, f"random scenes, seed {SETTINGS.random.seed}")
    )


def identified_behind(table):
    """The same of every scene whose identified constants have a row in a table."""
    runs = [run for run in table_runs(table) if run["scene"] and SETTINGS.is_identified(run["method"])]
    scenes = [SETTINGS.law_scene(run["scene"], run["method"]) for run in runs]
    return with_truths({Path(home(scene, "identified.json")).parent.name: table for scene in scenes})


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
        for run in SETTINGS.runs(table, method, column)
    ]


def is_made(table, method):
    """Whether all results of a row are there."""
    return all(Path(run["folder"], "metrics.json").exists() for run in method_runs(table, method))


# Looked up once, so that files which appear while jobs run change no job.
TABLE_METHODS = {
    name: [*table.methods, *(method for method in table.if_made if is_made(name, method))]
    for name, table in SETTINGS.tables.items()
}


def table_runs(table):
    """Every run behind a table, row by row and chain by chain, see `method_runs`."""
    return [run for method in TABLE_METHODS[table] for run in method_runs(table, method)]


def table_files(table, name):
    """A file of every run behind a table, in the order of `table_runs`."""
    return [f"{run['folder']}/{name}" for run in table_runs(table)]


def table_records(table):
    """Benchmark file and log of each job behind the scenes of a table, in all chains."""
    pairs = [SimpleNamespace(**run) for run in table_runs(table) if run["scene"]]
    makers = {"made": "render", "supplied": "supplied"}
    groups = ("binding", "geometry", "simulation", "laws", "rendering")
    jobs = [("kernels", {"group": group}) for group in groups]
    priors, laws, videos = [], [], []
    for pair in pairs:
        if SETTINGS.is_springs(pair.method):
            laws += [("kernels", {"group": "springs"}), ("springs", vars(pair))]
            priors += [prior_file(pair.scene)]
            continue
        scene = SETTINGS.law_scene(pair.scene, pair.method)
        own = Path(home(scene, "identified.json"))
        networks = material_prior(pair) == f"{own.parent}/priors/identified.safetensors"
        if SETTINGS.is_pac_nerf(pair.method):
            fitted = {"scene": scene, "method": SETTINGS.method_training(pair.method)}
            field = {"scene": Path(home(scene, FIELD)).parent.parent.name}
            laws += [("kernels", {"group": "radiance"}), ("radiance_field", field), ("pac_nerf", fitted)]
            priors += [prior_file(pair.scene)]
            continue
        identified = identified_law(pair) or identified_base(pair) or (networks and own)
        trained = trained_adaptor(pair)
        laws += [("identified_prior", {"scene": own.parent.name})] if networks else []
        laws += [identification(identified)] if identified else []
        method = SETTINGS.method_training(pair.method)
        laws += [("material", {"scene": scene, "method": method})] if trained else []
        priors += [prior_file(pair.scene), material_prior(pair)]
        videos += SETTINGS.video_scenes(scene) if identified or trained else []
    judged = [pair.scene for pair in pairs]
    priors += [prior_file(video) for video in videos]
    files = [Path(file) for file in priors if file]
    jobs += [("prior", {"prior": file.stem}) for file in files if file.parent == Path(RESULTS, "priors")]
    for run in dict.fromkeys([*judged, *videos]):
        scene, _ = SETTINGS.chain(run)
        origins = {part: origin_of(part, scene) for part in ("static", "dynamic")}
        if run in judged or "made" in origins.values():
            jobs += [("ground_truth", {"scene": scene})]
        jobs += [(f"{makers[origin]}_{part}", {"scene": scene}) for part, origin in origins.items()]
        makes = {rule: file for rule, file in MAKERS.items() if run in judged or rule != "tracers"}
        jobs += [(rule, {"scene": Path(home(run, file)).parent.name}) for rule, file in makes.items()]
    jobs += laws
    springs = {True: "springs_evaluation", False: "evaluation"}
    jobs += [(springs[SETTINGS.is_springs(pair.method)], vars(pair)) for pair in pairs]
    jobs += [("chamfer_table", {"table": table})]
    made = [(getattr(rules, name), wildcards) for name, wildcards in jobs]
    files = [(rule.benchmark, str(rule.log[0]), wildcards) for rule, wildcards in made]
    return list(dict.fromkeys(tuple(file.format(**w) for file in pair) for *pair, w in files))


def table_cells(table):
    """Method and column of every run behind a table, in the order of `table_runs`."""
    return [[run["method"], run["column"]] for run in table_runs(table)]


def bias_cells(table):
    """Scene, as its chain is called, and method of every run behind a table, in the order of `table_runs`."""
    return [{"scene": run["scene"], "method": run["method"]} for run in table_runs(table)]


def learning_rate_cells(table):
    """Method, learning-rate factor and scene of every run behind a table, in the order of `table_runs`."""
    return [
        {
            "method": run["method"].partition("+")[0],
            "lr_scale": SETTINGS.method_material(run["scene"], run["method"]).lr_scale,
            "scene": run["column"],
        }
        for run in table_runs(table)
    ]


def table_titles(table):
    """Row names of a table by method."""
    chosen = SETTINGS.tables[table]
    return {m: chosen.titles.get(m) or SETTINGS.method_title(m) for m in TABLE_METHODS[table]}


def table_notes(table):
    """What readers must know of the rows of a table, by method."""
    notes = {method: SETTINGS.method_note(method) for method in TABLE_METHODS[table]}
    return {method: note for method, note in notes.items() if note}


def table_columns(table):
    """Headings of a table by scene and experiment."""
    chosen = SETTINGS.tables[table]
    return {s: s for s in chosen.scenes} | {n: SETTINGS.experiments[n].title for n in chosen.experiments}
