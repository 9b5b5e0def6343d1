"""How wrong the stresses of laws are, on states that the true law goes through on the reconstruction."""


rule visited:
    input:
        **body_files(),
        kernels=kernels("simulation"),
        velocity=of_replicate("velocity.json"),
        obstacles=obstacle_meshes,
    output:
        visited=f"{RESULTS}/{{scene}}/visited.h5",
    resources:
        gpu=GPU,
    params:
        simulation=simulation_settings,
        density=scene_setting("density"),
        law=scene_setting("law"),
        frames=frame_steps,
        states=SETTINGS.evaluation.states,
        paths=SETTINGS.evaluation.paths,
        seed=SETTINGS.seed,
        device=SETTINGS.device,
    script:
        "../scripts/visited.py"


rule stress:
    input:
        unpack(of_bodies(law_files)),
        kernels=kernels("laws"),
        visited=of_replicate("visited.h5"),
    output:
        stress=f"{RESULTS}/{{scene}}/{{method}}/stress.json",
    params:
        dt=scene_setting("dt"),
        truth=scene_setting("law"),
        method=of_bodies(model_parameter),
        code=code_of("stress.py"),
    script:
        "../scripts/stress.py"


rule response:
    input:
        unpack(of_bodies(uncertainty_files)),
        kernels=kernels("laws"),
        # of the first replicate, so that the tests of all replicates have one axis
        visited=checked(lambda wildcards: result_path(SETTINGS.replicate(wildcards.scene)[0], "visited.h5")),
    output:
        response=f"{RESULTS}/{{scene}}/{{method}}/response.json",
    params:
        dt=scene_setting("dt"),
        truth=scene_setting("law"),
        method=of_bodies(model_parameter),
        uncertainty=of_case(lambda case: sorted(case.method.uncertainty_inputs(case))),
        rate=SETTINGS.figures.shear_rate,
        total_shear=SETTINGS.figures.total_shear,
        model_std=SETTINGS.identify.model_std,
        spread=SETTINGS.identify.spread,
        seed=SETTINGS.seed,
        code=code_of("response.py", draws=True),
    script:
        "../scripts/response.py"


rule stress_table:
    input:
        stress=lambda wildcards: table_files("stress", "stress.json"),
        responses=lambda wildcards: table_files("stress", "response.json"),
    output:
        csv=report(f"{RESULTS}/stress.csv", caption="../report/stress.rst", category="Tables"),
        markdown=f"{RESULTS}/stress.md",
    params:
        cells=lambda wildcards: table_cells("stress"),
        titles=lambda wildcards: table_titles("stress"),
        columns=lambda wildcards: table_columns("stress"),
    script:
        "../scripts/stress_table.py"
