"""What the papers print: tables, transforms, expected values with tolerances."""
