"""Random link events: what happens to a bus on a bad day, seeded."""

def break_link(*a): pass
