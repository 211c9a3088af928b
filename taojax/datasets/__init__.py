"""Makes data folders: simulated worlds, and edits of existing maps."""
