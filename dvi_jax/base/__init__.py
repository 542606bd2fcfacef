"""What every other part uses, without mechanics: types, statuses, checks, files."""
