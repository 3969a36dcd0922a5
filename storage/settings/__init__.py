"""Settings, described once at their fields: ranges, changes by dotted name, records."""
