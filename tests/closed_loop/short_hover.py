"""A scenario that takes only seconds, for campaigns that are killed."""

SCENARIO = """
name = "short"
help = "a hover that is over soon"
module = [{ number = 1, position_m = [0.0, 0.0, 0.4] }]
camera = [{}]
tank = {}
check = [{ metric = "position_rmse_m", high = 0.1 }]
task = { kind = "hover", settle_s = 3.0, duration_s = 4.0, centre_m = [0.0, 0.0, 0.4] }
"""
