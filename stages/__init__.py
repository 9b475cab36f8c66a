"""Stages of the pipeline, one module each; `pipeline.yaml` names their inputs."""
