"""Studies behind documented choices; each module runs as a script: `python -m wheretolook_paper.studies.<name>`."""
