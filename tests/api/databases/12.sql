BEGIN TRANSACTION;
CREATE TABLE alembic_version (
	version_num VARCHAR(32) NOT NULL, 
	CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num)
);
INSERT INTO "alembic_version" VALUES('0012');
CREATE TABLE analyses (
	model_id VARCHAR(64) NOT NULL, 
	kind VARCHAR(40) NOT NULL, 
	document JSON NOT NULL, 
	created_utc VARCHAR(32) NOT NULL, 
	PRIMARY KEY (model_id, kind), 
	FOREIGN KEY(model_id) REFERENCES models (id)
);
INSERT INTO "analyses" VALUES('m1','comparison','{"fit": 1}','2026-11-23T10:00:00.000Z');
CREATE TABLE approvals (
	id INTEGER NOT NULL, 
	model_id VARCHAR(64) NOT NULL, 
	participant VARCHAR(32) NOT NULL, 
	approved BOOLEAN NOT NULL, 
	reason TEXT NOT NULL, 
	"by" VARCHAR(80) NOT NULL, 
	at_utc VARCHAR(32) NOT NULL, expires_utc VARCHAR(32), tracking JSON, 
	PRIMARY KEY (id), 
	FOREIGN KEY(model_id) REFERENCES models (id), 
	FOREIGN KEY(participant) REFERENCES participants (code)
);
INSERT INTO "approvals" VALUES(1,'m1','P1',1,'follows well','Ada','2026-11-23T10:00:00.000Z','2026-11-24T00:00:00.000Z',NULL);
INSERT INTO "approvals" VALUES(2,'m1','P1',0,'undone: worse','Ada','2026-11-23T10:00:00.000Z',NULL,NULL);
CREATE TABLE audit (
	seq INTEGER NOT NULL, 
	at_utc VARCHAR(32) NOT NULL, 
	who VARCHAR(80) NOT NULL, 
	action VARCHAR(60) NOT NULL, 
	subject VARCHAR(120) NOT NULL, 
	detail JSON NOT NULL, 
	previous_hash VARCHAR(64) NOT NULL, 
	hash VARCHAR(64) NOT NULL, 
	PRIMARY KEY (seq)
);
INSERT INTO "audit" VALUES(1,'2026-11-23T10:00:00.000Z','Ada','approve','m1','{"reason": "follows well"}','0000000000000000000000000000000000000000000000000000000000000000','f37ba58dcd64d75f2b786f59994621fb8acac94c93e8915eedd7710a1361cc3e');
CREATE TABLE centre_chains (
	rig_id INTEGER NOT NULL, 
	chain VARCHAR NOT NULL, 
	seq INTEGER NOT NULL, 
	hash VARCHAR NOT NULL, 
	begun_utc VARCHAR NOT NULL, 
	PRIMARY KEY (rig_id, chain), 
	FOREIGN KEY(rig_id) REFERENCES centre_rigs (id)
);
CREATE TABLE centre_decisions (
	rig_id INTEGER NOT NULL, 
	sha256 VARCHAR NOT NULL, 
	participant VARCHAR NOT NULL, 
	model_id VARCHAR NOT NULL, 
	approved BOOLEAN NOT NULL, 
	reason TEXT NOT NULL, 
	"by" VARCHAR NOT NULL, 
	at_utc VARCHAR NOT NULL, 
	PRIMARY KEY (rig_id, sha256), 
	FOREIGN KEY(rig_id) REFERENCES centre_rigs (id)
);
CREATE TABLE centre_effects (
	effect VARCHAR NOT NULL, 
	participant VARCHAR NOT NULL, 
	rig_id INTEGER NOT NULL, 
	PRIMARY KEY (effect, participant, rig_id), 
	FOREIGN KEY(rig_id) REFERENCES centre_rigs (id)
);
CREATE TABLE centre_files (
	sha256 VARCHAR NOT NULL, 
	bytes INTEGER NOT NULL, 
	whole_utc VARCHAR NOT NULL, 
	checked_utc VARCHAR, 
	ok BOOLEAN NOT NULL, 
	PRIMARY KEY (sha256)
);
CREATE TABLE centre_items (
	rig_id INTEGER NOT NULL, 
	chain VARCHAR NOT NULL, 
	seq INTEGER NOT NULL, 
	kind VARCHAR NOT NULL, 
	"key" VARCHAR NOT NULL, 
	sha256 VARCHAR NOT NULL, 
	file VARCHAR, 
	file_bytes INTEGER, 
	at_utc VARCHAR NOT NULL, 
	received_utc VARCHAR NOT NULL, 
	previous VARCHAR NOT NULL, 
	hash VARCHAR NOT NULL, 
	body TEXT, 
	PRIMARY KEY (rig_id, chain, seq), 
	FOREIGN KEY(rig_id) REFERENCES centre_rigs (id)
);
CREATE TABLE centre_models (
	rig_id INTEGER NOT NULL, 
	id VARCHAR NOT NULL, 
	participant VARCHAR NOT NULL, 
	recording_id VARCHAR, 
	parent_id VARCHAR, 
	method VARCHAR, 
	effects JSON NOT NULL, 
	verdict VARCHAR, 
	fit JSON NOT NULL, 
	created_utc VARCHAR NOT NULL, 
	file VARCHAR, 
	file_bytes INTEGER, 
	PRIMARY KEY (rig_id, id), 
	FOREIGN KEY(rig_id) REFERENCES centre_rigs (id)
);
CREATE TABLE centre_participants (
	code VARCHAR NOT NULL, 
	rig_id INTEGER NOT NULL, 
	side VARCHAR, 
	muscle VARCHAR, 
	archived_utc VARCHAR, 
	sessions INTEGER NOT NULL, 
	recordings INTEGER NOT NULL, 
	last_utc VARCHAR, 
	verdict VARCHAR, 
	PRIMARY KEY (code, rig_id), 
	FOREIGN KEY(rig_id) REFERENCES centre_rigs (id)
);
CREATE TABLE centre_recordings (
	id INTEGER NOT NULL, 
	rig_id INTEGER NOT NULL, 
	recording_id VARCHAR NOT NULL, 
	participant VARCHAR NOT NULL, 
	test_id VARCHAR, 
	origin VARCHAR, 
	created_utc VARCHAR NOT NULL, 
	file VARCHAR, 
	file_bytes INTEGER, 
	PRIMARY KEY (id), 
	FOREIGN KEY(rig_id) REFERENCES centre_rigs (id)
);
CREATE TABLE centre_rigs (
	id INTEGER NOT NULL, 
	name VARCHAR NOT NULL, 
	key_hash VARCHAR NOT NULL, 
	key_prefix VARCHAR NOT NULL, 
	created_utc VARCHAR NOT NULL, 
	created_by VARCHAR NOT NULL, 
	revoked_utc VARCHAR, 
	seen_utc VARCHAR, 
	version VARCHAR, 
	state VARCHAR, 
	reason TEXT, 
	disk_free_bytes INTEGER, 
	disk_total_bytes INTEGER, 
	clock_difference_s FLOAT, 
	waiting_items INTEGER, 
	waiting_files INTEGER, 
	chain VARCHAR, 
	audit_seq INTEGER, 
	audit_hash VARCHAR, 
	recordings INTEGER NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (name), 
	UNIQUE (key_hash)
);
CREATE TABLE centre_sessions (
	participant VARCHAR NOT NULL, 
	day VARCHAR NOT NULL, 
	rig_id INTEGER NOT NULL, 
	at_utc VARCHAR NOT NULL, 
	tests INTEGER NOT NULL, 
	recordings INTEGER NOT NULL, 
	model_id VARCHAR, 
	model_utc VARCHAR, 
	verdict VARCHAR, 
	approved_by VARCHAR, 
	current_ma FLOAT, 
	PRIMARY KEY (participant, day, rig_id), 
	FOREIGN KEY(rig_id) REFERENCES centre_rigs (id)
);
CREATE TABLE centre_tests (
	rig_id INTEGER NOT NULL, 
	id VARCHAR NOT NULL, 
	participant VARCHAR NOT NULL, 
	kind VARCHAR, 
	state VARCHAR, 
	reason TEXT, 
	recording_id VARCHAR, 
	model_id VARCHAR, 
	requested_utc VARCHAR NOT NULL, 
	finished_utc VARCHAR, 
	PRIMARY KEY (rig_id, id), 
	FOREIGN KEY(rig_id) REFERENCES centre_rigs (id)
);
CREATE TABLE centre_wanted (
	id INTEGER NOT NULL, 
	rig_id INTEGER NOT NULL, 
	sha256 VARCHAR NOT NULL, 
	bytes INTEGER NOT NULL, 
	PRIMARY KEY (id), 
	FOREIGN KEY(rig_id) REFERENCES centre_rigs (id)
);
CREATE TABLE centre_warnings (
	id INTEGER NOT NULL, 
	rig_id INTEGER, 
	kind VARCHAR NOT NULL, 
	subject VARCHAR NOT NULL, 
	detail JSON NOT NULL, 
	at_utc VARCHAR NOT NULL, 
	again_utc VARCHAR NOT NULL, 
	times INTEGER NOT NULL, 
	ended_utc VARCHAR, 
	acknowledged_by VARCHAR, 
	acknowledged_utc VARCHAR, 
	PRIMARY KEY (id), 
	FOREIGN KEY(rig_id) REFERENCES centre_rigs (id)
);
CREATE TABLE confirmations (
	session_hash VARCHAR(64) NOT NULL, 
	at_unix_s FLOAT NOT NULL, 
	PRIMARY KEY (session_hash)
);
CREATE TABLE known_places (
	name VARCHAR(80) NOT NULL, 
	place VARCHAR(60) NOT NULL, 
	at_unix_s FLOAT NOT NULL, 
	PRIMARY KEY (name, place), 
	FOREIGN KEY(name) REFERENCES users (name)
);
CREATE TABLE models (
	id VARCHAR(64) NOT NULL, 
	participant VARCHAR(32) NOT NULL, 
	recording_id VARCHAR(64) NOT NULL, 
	parent_id VARCHAR(64), 
	added_effect VARCHAR(64), 
	method VARCHAR(40) NOT NULL, 
	effects JSON NOT NULL, 
	fit JSON NOT NULL, 
	document BLOB NOT NULL, 
	etag VARCHAR(64) NOT NULL, 
	created_utc VARCHAR(32) NOT NULL, 
	created_by VARCHAR(80) NOT NULL, carried_from_id VARCHAR(64), carried JSON, 
	PRIMARY KEY (id), 
	FOREIGN KEY(participant) REFERENCES participants (code), 
	FOREIGN KEY(recording_id) REFERENCES recordings (id)
);
INSERT INTO "models" VALUES('m1','P1','r1',NULL,NULL,'maximum-likelihood','[]','{"verdict": "good", "words": "", "reasons": []}',X'7B22736368656D615F76657273696F6E223A2022312E30222C20226D6F64656C5F6964223A20226D31227D','2f654da6ff67f294f7d4acbb47f024e02173175064c8ecb6edc54e463bb0fe7b','2026-11-23T10:00:00.000Z','administrator',NULL,NULL);
CREATE TABLE notes (
	id VARCHAR(40) NOT NULL, 
	participant VARCHAR(32) NOT NULL, 
	test_id VARCHAR(40), 
	at_s FLOAT, 
	kind VARCHAR(20) NOT NULL, 
	text TEXT NOT NULL, 
	"by" VARCHAR(80) NOT NULL, 
	at_utc VARCHAR(32) NOT NULL, 
	struck_by VARCHAR(80), 
	struck_utc VARCHAR(32), 
	PRIMARY KEY (id), 
	FOREIGN KEY(participant) REFERENCES participants (code), 
	FOREIGN KEY(test_id) REFERENCES tests (id)
);
INSERT INTO "notes" VALUES('N1','P1','T1',NULL,'electrodes','2 cm distal','Ada','2026-11-23T10:00:00.000Z',NULL,NULL);
CREATE TABLE outbox (
	id INTEGER NOT NULL, 
	chain VARCHAR NOT NULL, 
	seq INTEGER NOT NULL, 
	kind VARCHAR NOT NULL, 
	"key" VARCHAR NOT NULL, 
	body TEXT NOT NULL, 
	sha256 VARCHAR NOT NULL, 
	file VARCHAR, 
	file_bytes BIGINT, 
	at_utc VARCHAR NOT NULL, 
	previous VARCHAR NOT NULL, 
	hash VARCHAR NOT NULL, 
	PRIMARY KEY (id)
);
CREATE TABLE page_sessions (
	hash VARCHAR(64) NOT NULL, 
	token_hash VARCHAR(64) NOT NULL, 
	csrf VARCHAR(64) NOT NULL, 
	created_unix_s FLOAT NOT NULL, 
	expires_unix_s FLOAT NOT NULL, acted_unix_s FLOAT, locked_unix_s FLOAT, 
	PRIMARY KEY (hash), 
	FOREIGN KEY(token_hash) REFERENCES tokens (hash)
);
CREATE TABLE participants (
	code VARCHAR(32) NOT NULL, 
	profile JSON NOT NULL, 
	created_utc VARCHAR(32) NOT NULL, 
	created_by VARCHAR(80) NOT NULL, side VARCHAR(8), muscle VARCHAR(60), archived_utc VARCHAR(32), 
	PRIMARY KEY (code)
);
INSERT INTO "participants" VALUES('P1','{"current_ma": 20.0}','2026-11-23T10:00:00.000Z','administrator','left','biceps brachii',NULL);
CREATE TABLE recordings (
	id VARCHAR(64) NOT NULL, 
	participant VARCHAR(32) NOT NULL, 
	test_id VARCHAR(40), 
	path TEXT NOT NULL, 
	file_sha256 VARCHAR(64) NOT NULL, 
	origin VARCHAR(20) NOT NULL, 
	created_utc VARCHAR(32) NOT NULL, warnings JSON, 
	PRIMARY KEY (id), 
	FOREIGN KEY(participant) REFERENCES participants (code)
);
INSERT INTO "recordings" VALUES('r1','P1','T1','recordings/r1.h5','82f3e9c695dc6b8d1b11818d5701919e286de8d47f7c3eb3100c485f79e57828','rig','2026-11-23T10:00:00.000Z',NULL);
CREATE TABLE schema_version (
	version INTEGER NOT NULL, 
	PRIMARY KEY (version)
);
INSERT INTO "schema_version" VALUES(5);
CREATE TABLE secrets (
	name VARCHAR NOT NULL, 
	value BLOB NOT NULL, 
	PRIMARY KEY (name)
);
CREATE TABLE tests (
	id VARCHAR(40) NOT NULL, 
	participant VARCHAR(32) NOT NULL, 
	kind VARCHAR(40) NOT NULL, 
	state VARCHAR(20) NOT NULL, 
	reason TEXT NOT NULL, 
	"plan" JSON NOT NULL, 
	summary JSON NOT NULL, 
	recording_id VARCHAR(64), 
	model_id VARCHAR(64), 
	requested_by VARCHAR(80) NOT NULL, 
	requested_utc VARCHAR(32) NOT NULL, 
	finished_utc VARCHAR(32), ran_by VARCHAR(80), followed_by VARCHAR, rig VARCHAR, 
	PRIMARY KEY (id), 
	FOREIGN KEY(participant) REFERENCES participants (code)
);
INSERT INTO "tests" VALUES('T1','P1','pre-session','completed','','{"test_id": "T1"}','{}','r1','m1','Ada','2026-11-23T10:00:00.000Z','2026-11-23T10:00:00.000Z',NULL,NULL,NULL);
CREATE TABLE tokens (
	hash VARCHAR(64) NOT NULL, 
	prefix VARCHAR(16) NOT NULL, 
	name VARCHAR(80) NOT NULL, 
	scopes JSON NOT NULL, 
	created_utc VARCHAR(32) NOT NULL, 
	expires_utc VARCHAR(32), 
	revoked BOOLEAN NOT NULL, 
	origin VARCHAR(20) NOT NULL, participant VARCHAR(32), "plan" JSON, made_by VARCHAR(64), 
	PRIMARY KEY (hash)
);
INSERT INTO "tokens" VALUES('aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa','stimrig_','script','["read-live"]','2026-11-23T10:00:00.000Z',NULL,0,'issued',NULL,NULL,NULL);
CREATE TABLE tracked (
	test_id VARCHAR(40) NOT NULL, 
	approval_id INTEGER NOT NULL, 
	participant VARCHAR(32) NOT NULL, 
	model_id VARCHAR(64) NOT NULL, 
	recording_id VARCHAR(64), 
	number INTEGER NOT NULL, 
	outcome VARCHAR(20) NOT NULL, 
	reason TEXT NOT NULL, 
	step JSON, 
	error_percent FLOAT, 
	ask TEXT, 
	document BLOB, 
	etag VARCHAR(64), 
	at_utc VARCHAR(32) NOT NULL, 
	delay_s FLOAT, 
	PRIMARY KEY (test_id), 
	FOREIGN KEY(test_id) REFERENCES tests (id), 
	FOREIGN KEY(approval_id) REFERENCES approvals (id), 
	FOREIGN KEY(participant) REFERENCES participants (code), 
	FOREIGN KEY(model_id) REFERENCES models (id)
);
CREATE TABLE users (
	name VARCHAR(80) NOT NULL, 
	password_hash VARCHAR(200) NOT NULL, 
	token_hash VARCHAR(64) NOT NULL, 
	created_utc VARCHAR(32) NOT NULL, 
	changed_utc VARCHAR(32) NOT NULL, folded_name VARCHAR(320), 
	PRIMARY KEY (name), 
	FOREIGN KEY(token_hash) REFERENCES tokens (hash)
);
INSERT INTO "users" VALUES('Jörg  MÜLLER','x','aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa','2026-11-23T10:00:00.000Z','2026-11-23T10:00:00.000Z','jörg müller');
CREATE INDEX ix_tests_participant ON tests (participant);
CREATE INDEX ix_tests_state ON tests (state);
CREATE INDEX ix_tests_requested_utc ON tests (requested_utc);
CREATE INDEX ix_recordings_test_id ON recordings (test_id);
CREATE INDEX ix_recordings_participant ON recordings (participant);
CREATE INDEX ix_models_recording_id ON models (recording_id);
CREATE INDEX ix_models_participant ON models (participant);
CREATE INDEX ix_models_created_utc ON models (created_utc);
CREATE INDEX ix_approvals_model_id ON approvals (model_id);
CREATE INDEX ix_approvals_participant ON approvals (participant);
CREATE INDEX ix_tokens_name ON tokens (name);
CREATE INDEX ix_notes_test_id ON notes (test_id);
CREATE INDEX ix_notes_participant ON notes (participant);
CREATE INDEX ix_users_folded_name ON users (folded_name);
CREATE INDEX ix_tracked_approval_id ON tracked (approval_id);
CREATE INDEX ix_outbox_file ON outbox (file);
CREATE UNIQUE INDEX ix_outbox_chain_seq ON outbox (chain, seq);
CREATE INDEX ix_outbox_kind_key ON outbox (kind, "key");
CREATE INDEX ix_centre_items_file ON centre_items (file);
CREATE INDEX ix_centre_items_told ON centre_items (rig_id, kind, "key");
CREATE UNIQUE INDEX ix_centre_wanted_file ON centre_wanted (sha256, rig_id);
CREATE INDEX ix_centre_wanted_rig ON centre_wanted (rig_id, id);
CREATE INDEX ix_centre_warnings_of ON centre_warnings (rig_id, kind, subject);
CREATE INDEX ix_centre_warnings_open ON centre_warnings (acknowledged_utc, id);
CREATE INDEX ix_centre_participants_rig ON centre_participants (rig_id, code);
CREATE INDEX ix_centre_sessions_day ON centre_sessions (day, participant, rig_id);
CREATE INDEX ix_centre_sessions_rig ON centre_sessions (participant, rig_id, day);
CREATE INDEX ix_centre_sessions_verdict ON centre_sessions (verdict, participant, rig_id, day);
CREATE INDEX ix_centre_tests_participant ON centre_tests (participant, requested_utc);
CREATE UNIQUE INDEX ix_centre_recordings_of ON centre_recordings (rig_id, recording_id);
CREATE INDEX ix_centre_recordings_participant ON centre_recordings (participant, created_utc, id);
CREATE INDEX ix_centre_recordings_rig ON centre_recordings (rig_id, created_utc, id);
CREATE INDEX ix_centre_recordings_time ON centre_recordings (created_utc, id);
CREATE INDEX ix_centre_models_participant ON centre_models (participant, created_utc);
CREATE INDEX ix_centre_decisions_participant ON centre_decisions (participant, at_utc);
COMMIT;
