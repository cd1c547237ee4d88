// The same day with the client that @hey-api/openapi-ts made.
import { client } from "./made/client.gen";
import { approvedModel, oneModel, oneParticipant, oneTest, prediction, recording, startTest, stop, tracking, widths } from "./made/sdk.gen";

declare const process: { argv: string[]; exit(code: number): never };

function must<T>(answer: { data?: T; error?: unknown; response?: Response }): T {
  if (answer.data === undefined) throw new Error(`${answer.response?.status} ${JSON.stringify(answer.error)}`);
  return answer.data;
}

async function day(url: string, token: string, code: string): Promise<void> {
  client.setConfig({ baseUrl: url, auth: token });
  const first = await approvedModel({ path: { code } });
  const model = must(first);
  const again = await approvedModel({ path: { code }, headers: { "if-none-match": first.response?.headers.get("etag") } });
  const torque = must(await prediction({ path: { model_id: model.model_id }, body: { pulse_width_us: [0, 150, 200] } }));
  const reference = Array.from({ length: 100 }, (_, pulse) => (pulse >= 20 && pulse < 80 ? 0.5 : 0));
  const plan = must(await widths({ path: { model_id: model.model_id }, body: { reference_torque_nm: reference } }));
  const seen = (await oneParticipant({ path: { code } })).response?.headers.get("etag") ?? "";
  const body = { participant: code, kind: "sequence", segments: plan.segments, pulse_rate_hz: plan.pulse_rate_hz };
  const begun = must(await startTest({ body, headers: { "If-Match": seen } }));
  let now = begun;
  while (!now.done) {
    await new Promise((done) => setTimeout(done, 100));
    now = must(await oneTest({ path: { test_id: begun.id } }));
  }
  const record = must(await recording({ path: { recording_id: now.recording_id ?? "" }, parseAs: "blob" })) as Blob;
  const start = new Uint8Array(await record.slice(0, 4).arrayBuffer());
  const told = must(await tracking({ path: { code } }));
  const missing = await oneModel({ path: { model_id: "nothing" } });
  const stopped = await stop();
  console.log(JSON.stringify({
    sample_rate_hz: model.sample_rate_hz, again: again.response?.status, torques: torque.torque_nm.length,
    widths: plan.pulse_width_us.length, state: now.state, record: Array.from(start, (byte) => byte.toString(16).padStart(2, "0")).join(""),
    trials: told.trials.length, missing: missing.error?.title, stopped: stopped.response?.status,
  }));
}

const [url, token, code] = process.argv.slice(2);
day(url, token, code).catch((error) => { console.error(error); process.exit(1); });
