"""Family and constants of the material, found in the video; what training could start from, or a law by itself."""


rule identify:
    input:
        **body_files(),
        kernels=kernels("laws", "rendering"),
        transforms=of_scene("dynamic/transforms.json"),
        velocity=of_chain("velocity.json"),
    output:
        identified=f"{RESULTS}/{{scene}}/identified.json",
    resources:
        gpu=GPU,
    params:
        simulation=simulation_settings,
        density=scene_setting("density"),
        identify=SETTINGS.identify.plain(),
        stock=stock_law,
        device=SETTINGS.device,
    script:
        "../scripts/identify.py"


rule identified_page:
    input:
        identified=f"{RESULTS}/{{scene}}/identified.json",
    output:
        page=f"{RESULTS}/{{scene}}/identified.png",
    params:
        law=scene_setting("law"),
    script:
        "../scripts/identified_page.py"
