"""What a robot could run: sensor files in, one sealed table of signals out."""
