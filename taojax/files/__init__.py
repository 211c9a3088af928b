"""What lies between the rooms: sealed records, tables and specs, atomic writes, pose graphs."""
