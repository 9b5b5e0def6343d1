"""The figures of the paper and some of our own, one module for each.

The docstring of a module is the figure's caption in the report (reStructuredText). ``data(inputs, params, log)``
returns the data of the figure, an `ImageGrid` or plain numbers for a JSON file. ``inputs`` and ``params`` have the
attributes of the figure's entry in ``workflow/rules/figure_table.smk``, and ``log`` logs a line. ``draw(data)`` returns
the figure of matplotlib, drawn from the data file.
"""
