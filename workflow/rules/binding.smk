"""Gaussians to particles (paper Algorithm 1)."""


rule binding:
    input:
        kernels=kernels("binding"),
        gaussians=of_replicate("gaussians.ply"),
        sampled=of_replicate("sampled_particles.h5"),
    output:
        binding=f"{RESULTS}/{{scene}}/binding.h5",
        particles=f"{RESULTS}/{{scene}}/particles.h5",
    wildcard_constraints:
        scene=f"{PICTURED_SCENE}|{PART_SCENE}|{SPLAT_SCENE}",
    params:
        binding=SETTINGS.binding.plain(),
        # a splat may be bound to the sampled particles alone
        own_particles=of_section(lambda scene: scene.splat.own_particles if scene.splat else True),
    script:
        "../scripts/binding.py"
