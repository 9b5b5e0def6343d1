"""Inputs of predictions of splats. Needs methods.smk."""

@checked
def splat_start(wildcards):
    """File of the initial motion of a splat. Its law is that of another scene, as it has no video."""
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


def splat_clock(choose):
    """A function of wildcards: something of the time step [s] and the frames of a splat's motion."""
    return checked(lambda wildcards: choose(*cases.motion_clock(SETTINGS, wildcards.scene, wildcards.method)))
