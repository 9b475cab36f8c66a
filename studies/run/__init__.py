"""How the project's runner sees a study, and the command line."""
