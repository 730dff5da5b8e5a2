"""Ready scenes (YAML), runnable by name: `gdpro simulate NAME`."""
