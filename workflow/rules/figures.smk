"""Figures: one entry of FIGURES (figure_table.smk) and one module of neuma_lib/paper/figures make one."""

import re

for figure, made_of in FIGURES.items():

    rule:
        name:
            re.sub(r"\W", "_", figure)
        input:
            **made_of["input"],
        output:
            data=f"{RESULTS}/figures/{figure}.{made_of['kind']}",
            png=report(
                f"{RESULTS}/figures/{figure}.png",
                caption="../report/figure.rst",
                category="Figures",
                labels={"figure": figure},
            ),
            pdf=f"{RESULTS}/figures/{figure}.pdf",
        resources:
            **{"mem_mb": 6000, **made_of.get("resources", {})},
        params:
            **made_of["params"],
            figure=made_of.get("module", figure),
            module=digest_of(figure_module(made_of.get("module", figure))),
        script:
            "../scripts/figure.py"


rule figures:
    input:
        expand(
            f"{RESULTS}/figures/{{figure}}.{{kind}}",
            figure=[name for name, made_of in FIGURES.items() if made_of.get("default_target", True)],
            kind=["png", "pdf"],
        ),
