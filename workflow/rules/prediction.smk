"""Inputs of predictions of splats and of exported motions. Needs methods.smk."""


def splat_setting(choose):
    """A function of wildcards: something of the settings of their scene's splat."""
    return checked(lambda wildcards: choose(SETTINGS.scene(wildcards.scene)))


@checked
def splat_start(wildcards):
    """The start of a splat; its law comes from elsewhere, as it has no video to learn one from."""
    scene, method = wildcards.scene, wildcards.method
    case = case_on(scene, method)
    case.method.model_options(case)  # refuses a true law, which a splat does not have
    if case.learned_from_moved_scene:
        raise InputError(
            f"{scene}/{method}",
            "a splat has no video to learn a law from",
            f"Use the law of another scene, {method}+{LAW_FROM}=<scene>, or the prior alone, nclaw",
        )
    return of_replicate("velocity.json")(wildcards)


@checked
def splat_simulation(wildcards):
    dt, _ = cases.motion_clock(SETTINGS, wildcards.scene, wildcards.method)
    return simulator(dt)


@checked
def splat_frames(wildcards):
    _, frames = cases.motion_clock(SETTINGS, wildcards.scene, wildcards.method)
    return list(frames)


@checked
def body_densities(wildcards):
    """Densities of the bodies of a scene or an experiment."""
    scenes = SETTINGS.body_scenes(subject(wildcards))
    return [SETTINGS.scene(scene).plain()["density"] for scene in scenes]
