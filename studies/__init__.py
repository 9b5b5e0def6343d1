"""Studies that use the library and the workflow; not installed."""
