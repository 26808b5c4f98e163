"""One short script per library: what a user of it would write, at settings that serve it well."""
