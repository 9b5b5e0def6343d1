"""Gaussians to particles (paper Algorithm 1)."""


rule binding:
    input:
        kernels=kernels("binding"),
        gaussians=of_chain("gaussians.ply"),
        sampled=of_chain("sampled_particles.h5"),
    output:
        binding=f"{RESULTS}/{{scene}}/binding.h5",
        particles=f"{RESULTS}/{{scene}}/particles.h5",
    wildcard_constraints:
        scene=PICTURED_SCENE,
    params:
        binding=SETTINGS.binding.plain(),
    script:
        "../scripts/binding.py"
