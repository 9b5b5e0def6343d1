"""Gaussians to particles (paper Algorithm 1)."""


rule binding:
    input:
        gaussians=f"{RESULTS}/{{scene}}/gaussians.ply",
        sampled=f"{RESULTS}/{{scene}}/sampled_particles.h5",
    output:
        binding=f"{RESULTS}/{{scene}}/binding.h5",
        particles=f"{RESULTS}/{{scene}}/particles.h5",
    params:
        binding=SETTINGS.binding.plain(),
    script:
        "../scripts/binding.py"
