"""Makes data folders: public sets, files as they are, simulated worlds, edits and kidnaps."""
