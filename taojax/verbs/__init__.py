"""The verbs of the command line, one file each; a verb imports its room only when it runs."""
