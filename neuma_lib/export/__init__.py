"""Laws and scenes for other engines: Genesis, newton, MuJoCo, and USD files."""
