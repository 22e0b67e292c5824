"""The planner: from an area and a request to a flight plan and its missions."""
