collect_ignore = ["in_materialx.py"]  # runs in a process of its own, where MaterialX is installed
