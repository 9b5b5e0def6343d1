"""Commands of ``neuma`` by room. Each loads what it needs when it runs."""
