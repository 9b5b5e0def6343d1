"""The figures of the paper and two of our own: one module a figure.

A module holds a figure's data and its drawing; a line of the table in ``workflow/rules/figure_table.smk`` says what
it is made of. The docstring of the module is the figure's caption in the report (reStructuredText). ``data(inputs,
params, say)`` gives what is shown: an `ImageGrid`, or plain numbers for a JSON file. ``inputs`` and ``params`` have
the attributes that the table names, files as paths; ``say`` takes a line for the log. ``draw(data)`` gives the figure
of matplotlib, from what was read back from the data file.
"""
