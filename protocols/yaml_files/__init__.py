"""How YAML files are read: strictly, with every mistake named by its line and key path."""
