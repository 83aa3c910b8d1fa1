"""What programs around real UAVs, as in ``examples/fleet``, may use of damian, beside its own
public names.

A test of theirs holds them to it, so that all other names can change freely.
"""

PUBLIC = """
damian: keys
damian.baselines.script: script_policy
damian.common.checks: SECONDS, require
damian.common.counter_rng: number_of
damian.common.errors: InputError, RunError
damian.common.fields: Settings, rules, setting
damian.common.plotting: UAV_COLOURS
damian.common.tables: write_csv
damian.common.tensors: tree_map
damian.common.text_files: listed, named, one_line, parse_table, read_text, show
damian.delays.clocks: AGREE, LATEST_MEDIAN, UNSET, in_order
damian.delays.logs: LATEST, UNKNOWN, column_of, delays_of, seconds_of
damian.envs.config: ScenarioConfig
damian.envs.delayed_env: DelayedEnv
damian.envs.nodes: Belief, ServerNode
damian.envs.pipeline: observation_transforms, remembering_transforms
damian.envs.uav_env: Outputs, UavEnv
damian.models.memory: AgentGRU
damian.server.belief: report_rows
damian.server.server: Features
damian.show.episode: Episode, at_instant, episode_of
damian.show.files: save_episode, summary
damian.show.replay_page: PAGE
damian.transforms: ObservationTimeline, StatefulTransform
damian.transforms.entries: Entries
damian.world.airspace: Airspace
damian.world.battery: flight_drain, observed
damian.world.config: BatteryConfig
damian.world.messages: Messages
damian.world.regions.geodesy: to_latlon, to_local
damian.world.state: PackedState, State, Truth
damian.world.vehicles: check_levels
"""
"""Names by their modules."""
