"""Figures: each is drawn by a rule of its own from a data file of its own, which another rule makes."""

# ---- the drawings: the same rule for each


for figure, kind in DATA_FILES.items():

    rule:
        name:
            figure
        input:
            data=f"{FIGURES}/{figure}.{kind}",
        output:
            png=report(
                f"{FIGURES}/{figure}.png",
                caption=f"../report/{figure}.rst",
                category="Figures",
                labels={"figure": figure},
            ),
            pdf=f"{FIGURES}/{figure}.pdf",
        params:
            figure=figure,
            drawing=code_digest(ROOT / "neuma_lib" / "evaluation" / "figures" / f"{figure}.py"),
        script:
            "../scripts/figure.py"


# ---- their data


rule ch_dist_curve_data:
    input:
        metrics=of_cells(COMPARED, "metrics.json") if COMPARED else [],
    output:
        data=f"{FIGURES}/ch_dist_curve.json",
    params:
        titles=TITLES,
        scenes={scene: SETTINGS.scene(scene).dt for scene in (COMPARED.scenes if COMPARED else ())},
    script:
        "../scripts/ch_dist_curve_data.py"


rule image_quality_data:
    input:
        metrics=of_cells(COMPARED, "image_metrics.json") if COMPARED else [],
    output:
        data=f"{FIGURES}/image_quality.json",
    params:
        titles=TITLES,
        scenes=list(COMPARED.scenes if COMPARED else ()),
    script:
        "../scripts/image_quality_data.py"


rule main_res_data:
    input:
        kernels=kernels("rendering"),
        transforms=of_scenes(f"{DATA}/{{scene}}/dynamic/transforms.json", DRAWN.main_res),
        gaussians=of_scenes(f"{RESULTS}/{{scene}}/gaussians.ply", DRAWN.main_res),
        binding=of_scenes(f"{RESULTS}/{{scene}}/binding.h5", DRAWN.main_res),
        rollouts=of_methods(DRAWN.main_res, METHODS, "rollout.h5"),
    output:
        data=f"{FIGURES}/main_res.h5",
    resources:
        mem_mb=6000,
    params:
        titles=TITLES,
        scenes=scene_constants(DRAWN.main_res),
        view=DRAWN.view,
        shown=DRAWN.shown,
        magnify=DRAWN.magnify,
    script:
        "../scripts/main_res_data.py"


rule particles_app_data:
    input:
        truth=f"{DATA}/{DRAWN.particles_app}/particles.h5",
        binding=f"{RESULTS}/{DRAWN.particles_app}/binding.h5",
        rollouts=of_methods([DRAWN.particles_app], METHODS, "rollout.h5"),
    output:
        data=f"{FIGURES}/particles_app.h5",
    resources:
        mem_mb=6000,
    params:
        titles=TITLES,
        dt=SETTINGS.scene(DRAWN.particles_app).dt,
        shown=DRAWN.shown + 3,
        size=DRAWN.size,
    script:
        "../scripts/particles_app_data.py"


rule lora_alphav_data:
    input:
        kernels=kernels("laws", "rendering"),
        transforms=of_scenes(f"{DATA}/{{scene}}/dynamic/transforms.json", DRAWN.lora_alphav),
        truth=of_scenes(f"{DATA}/{{scene}}/particles.h5", DRAWN.lora_alphav),
        gaussians=of_scenes(f"{RESULTS}/{{scene}}/gaussians.ply", DRAWN.lora_alphav),
        binding=of_scenes(f"{RESULTS}/{{scene}}/binding.h5", DRAWN.lora_alphav),
        velocity=of_scenes(f"{RESULTS}/{{scene}}/velocity.json", DRAWN.lora_alphav),
        prior=priors_of(DRAWN.lora_alphav),
        adaptor=of_scenes(f"{RESULTS}/{{scene}}/neuma/adaptor.safetensors", DRAWN.lora_alphav),
    output:
        data=f"{FIGURES}/lora_alphav.h5",
    resources:
        gpu=GPU,
        mem_mb=8000,
    params:
        scenes=scene_constants(DRAWN.lora_alphav),
        weights=list(DRAWN.weights),
        view=DRAWN.view,
        shown=DRAWN.shown - 1,
        magnify=DRAWN.magnify,
        device=SETTINGS.device,
    script:
        "../scripts/lora_alphav_data.py"


rule vis_generalize_data:
    input:
        kernels=kernels("rendering"),
        rollouts=of_experiments([*DRAWN.letters, *DRAWN.meetings], "neuma/rollout.h5"),
        gaussians=of_experiments([*DRAWN.letters, *DRAWN.meetings], "gaussians.ply"),
        binding=of_experiments([*DRAWN.letters, *DRAWN.meetings], "binding.h5"),
    output:
        data=f"{FIGURES}/vis_generalize.h5",
    resources:
        mem_mb=6000,
    params:
        letters=lambda wildcards: [
            {"letter": body["shape"].removeprefix("letter_"), "material": body["scene"]}
            for body in (SETTINGS.experiment_bodies(name)[0] for name in DRAWN.letters)
        ],
        others=lambda wildcards: {name: SETTINGS.experiment(name).title for name in DRAWN.meetings},
        shown=DRAWN.shown - 1,
        size=DRAWN.size,
    script:
        "../scripts/vis_generalize_data.py"


rule ext_time_data:
    input:
        kernels=kernels("rendering"),
        truth=f"{DATA}/experiments/{DRAWN.ext_time}/particles.h5",
        gaussians=f"{RESULTS}/experiments/{DRAWN.ext_time}/gaussians.ply",
        binding=f"{RESULTS}/experiments/{DRAWN.ext_time}/binding.h5",
        rollouts=expand(f"{RESULTS}/experiments/{DRAWN.ext_time}/{{method}}/rollout.h5", method=PREDICTED),
    output:
        data=f"{FIGURES}/ext_time.h5",
    resources:
        mem_mb=6000,
    params:
        titles={method: SETTINGS.method_title(method) for method in PREDICTED},
        density=lambda wildcards: SETTINGS.experiment_bodies(DRAWN.ext_time)[0]["density"],
        observed=lambda wildcards: video_length(SETTINGS.experiment(DRAWN.ext_time).bodies[0].scene),
        shown=DRAWN.shown + 4,
        size=DRAWN.size,
    script:
        "../scripts/ext_time_data.py"


rule gradient_analysis_data:
    input:
        kernels=kernels("laws"),
        history=of_methods(DRAWN.gradient_analysis, ["neuma"], "history.json"),
        adaptor=of_methods(DRAWN.gradient_analysis, ["neuma"], "adaptor.safetensors"),
        prior=priors_of(DRAWN.gradient_analysis),
    output:
        data=f"{FIGURES}/gradient_analysis.json",
    params:
        scenes={scene: wrong_laws(scene) for scene in DRAWN.gradient_analysis},
    script:
        "../scripts/gradient_analysis_data.py"


rule uneven_mass_data:
    input:
        kernels=kernels("rendering"),
        transforms=of_scenes(f"{DATA}/{{scene}}/dynamic/transforms.json", UNEVEN.scenes if UNEVEN else ()),
        gaussians=of_scenes(f"{RESULTS}/{{scene}}/gaussians.ply", UNEVEN.scenes if UNEVEN else ()),
        binding=of_scenes(f"{RESULTS}/{{scene}}/binding.h5", UNEVEN.scenes if UNEVEN else ()),
        rollouts=of_cells(UNEVEN, "rollout.h5") if UNEVEN else [],
        metrics=of_cells(UNEVEN, "metrics.json") if UNEVEN else [],
    output:
        data=f"{FIGURES}/uneven_mass.h5",
    resources:
        mem_mb=6000,
    params:
        titles=table_titles("uneven_mass") if UNEVEN else {},
        scene=scene_constants(UNEVEN.scenes if UNEVEN else ()),
        view=DRAWN.view,
        shown=DRAWN.shown,
        magnify=DRAWN.magnify,
    script:
        "../scripts/uneven_mass_data.py"


rule pipeline_data:
    input:
        kernels=kernels("laws", "rendering"),
        static=f"{DATA}/{DRAWN.pipeline}/static/transforms.json",
        transforms=f"{DATA}/{DRAWN.pipeline}/dynamic/transforms.json",
        gaussians=f"{RESULTS}/{DRAWN.pipeline}/gaussians.ply",
        binding=f"{RESULTS}/{DRAWN.pipeline}/binding.h5",
        mesh=f"{RESULTS}/{DRAWN.pipeline}/mesh.ply",
        prior=priors_of([DRAWN.pipeline]),
        adaptor=f"{RESULTS}/{DRAWN.pipeline}/neuma/adaptor.safetensors",
        rollout=f"{RESULTS}/{DRAWN.pipeline}/neuma/rollout.h5",
    output:
        data=f"{FIGURES}/pipeline.h5",
    resources:
        mem_mb=6000,
    params:
        scene=scene_constants([DRAWN.pipeline])[DRAWN.pipeline],
        views=SETTINGS.dataset.static.views,
        view=DRAWN.view,
        magnify=DRAWN.magnify,
    script:
        "../scripts/pipeline_data.py"


rule material_response_data:
    input:
        kernels=kernels("laws"),
        truth=of_scenes(f"{DATA}/{{scene}}/particles.h5", DRAWN.material_response),
        prior=priors_of(DRAWN.material_response),
        adaptor=of_methods(DRAWN.material_response, ["neuma"], "adaptor.safetensors"),
    output:
        data=f"{FIGURES}/material_response.json",
    resources:
        mem_mb=6000,
    params:
        scenes=scene_constants(DRAWN.material_response),
        rate=DRAWN.shear_rate,
        total_shear=DRAWN.total_shear,
    script:
        "../scripts/material_response_data.py"


rule ablation_gradients_data:
    input:
        histories=of_cells(ABLATION, "history.json") if ABLATION else [],
        metrics=of_cells(ABLATION, "metrics.json") if ABLATION else [],
        image_metrics=of_cells(ABLATION, "image_metrics.json") if ABLATION else [],
    output:
        data=f"{FIGURES}/ablation_gradients.json",
    params:
        titles=table_titles("ablation_gradients") if ABLATION else {},
        scenes=list(ABLATION.scenes if ABLATION else ()),
    script:
        "../scripts/ablation_gradients_data.py"


rule figures:
    input:
        expand(f"{FIGURES}/{{figure}}.{{kind}}", figure=DATA_FILES, kind=["png", "pdf"]),
